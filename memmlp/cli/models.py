"""`memmlp models`: the trained networks that the package ships."""

from collections.abc import Iterator, Mapping
from typing import Any

import click

from memmlp.common.errors import InputError
from memmlp.common.processes import MIN_CORE_FRACTION
from memmlp.common.text_formats import make_console
from memmlp.runs.lookup import find_shipped_clip, list_shipped, read_card


@click.command("models")
@click.argument("name", required=False)
@click.option("--markdown", is_flag=True, help="Print the cards as Markdown, for the documentation.")
def models(name: str | None, markdown: bool) -> None:
    """List the shipped networks, or show the card of the network NAME.

    A name works wherever a run is named: memmlp live NAME, predict, render, export, web, eval, and
    memmlp.Stream(NAME) in Python.
    """
    names = list_shipped()
    if name is not None and name not in names:
        raise InputError(f"NAME {name}: must be one of {', '.join(names)}")
    cards = [read_card(one) for one in ([name] if name else names)]
    if name or markdown:
        text = "\n".join(line for card in cards for line in format_card(card))
        click.echo(text if markdown else text.replace("`", ""))
    else:
        list_networks(cards)


def list_networks(cards: list[dict[str, Any]]) -> None:
    """Print a line for each network, with its errors on unseen persons."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("name", no_wrap=True)
    for header in ("MPJRE\ndeg", "MPJPE\ncm", "MPJVE\ncm/s", "Jitter\n10² m/s³", "parameters\nM"):
        table.add_column(header, justify="right")
    for card in cards:
        errors = card["errors"]["rotation"]
        shown = (f"{errors[metric][0]:.2f}" for metric in ("MPJRE", "MPJPE", "MPJVE", "Jitter"))
        table.add_row(card["name"], *shown, f"{card['parameters'] / 1e6:.2f}")
    make_console().print(table)
    persons, minutes = cards[0]["persons"]["test"], cards[0]["minutes"]["test"]
    click.echo(f"errors in stream mode on {len(persons)} persons of no training ({minutes:g} minutes)")
    click.echo("details: memmlp models NAME; see one move: memmlp live NAME")
    click.echo(f"clip: {find_shipped_clip()}")


def format_card(card: Mapping[str, Any]) -> Iterator[str]:
    recipe, persons, clip, latency = card["recipe"], card["persons"], card["clip"], card["latency"]
    yield f"## `{card['name']}`: {card['title']}"
    yield ""
    yield "| part | persons | clips | minutes |"
    yield "|---|---|---:|---:|"
    for part, own in persons.items():
        yield f"| {part} | {', '.join(own)} | {card['clips'][part]} | {card['minutes'][part]:g} |"
    yield ""
    count = len(persons["test"])
    yield f"Errors as a live stream (mode `stream`), with 95 % intervals over {count} test persons:"
    yield ""
    yield "| branch | MPJRE deg | MPJPE cm | MPJVE cm/s | Jitter 10² m/s³ |"
    yield "|---|---:|---:|---:|---:|"
    for branch, row in card["errors"].items():
        if branch == "position" and row["MPJPE"] == card["errors"]["rotation"]["MPJPE"]:
            continue  # a network without position branch
        cells = [_format_interval(row.get(metric)) for metric in ("MPJRE", "MPJPE", "MPJVE", "Jitter")]
        yield f"| {branch} | {' | '.join(cells)} |"
    errors = card["errors"]["rotation"]
    yield ""
    if "GT Jitter" in errors:
        yield f"- The true Jitter of all test clips is {errors['GT Jitter'][0]:.2f}."
    yield (
        f"- On the shipped clip (`{clip['name']}`, {clip['seconds']:g} s, a test person): "
        f"MPJPE {clip['errors']['rotation']['MPJPE']:.2f} cm."
    )
    yield (
        f"- Training: {recipe['steps']} steps of {recipe['batch']} windows of {recipe['frames']} frames, "
        f"{recipe['name']}, learning rate {recipe['lr']:g}; the weights of step {recipe['best_step']} "
        f"had the lowest {recipe['best_by']} MPJPE on validation persons."
    )
    if others := card.get("candidates"):
        shown = "; ".join(
            f"{one['tflop']:g} TFLOP{' mirrored' * one['mirror']} {one['validation MPJPE']:.2f} cm"
            for one in others
        )
        yield f"- Chosen by validation MPJPE from trainings with and without mirrored windows: {shown}."
    yield f"- Size: {card['parameters'] / 1e6:.2f} M parameters, {card['weights']}."
    if latency["core_share"] < MIN_CORE_FRACTION:
        yield "- Latency: not measured on a quiet machine yet."
    else:
        yield (
            f"- A step on one core ({latency['cpu']}): {latency['median_ms']:.2f} ms, median; "
            f"{latency['ratio_to_yardstick']:.2f} times the yardstick."
        )
    yield f"- Command: `{card['command']}` (commit `{card['commit'][:8]}`)."
    yield f"- Terms: {card['terms']}"
    yield ""


def _format_interval(numbers: list[float] | None) -> str:
    if numbers is None:
        return "-"
    mean, low, high = numbers
    return f"{mean:.2f}" + ("" if low is None else f" [{low:.2f}, {high:.2f}]")
