"""The server: what it answers, and to whom."""

import http.client
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import pytest
from processes import until
from report.ui.conftest import predict, run_of, started_run

from memmlp.report.ui.server import FILES, Answers, RunsServer


class Answer(NamedTuple):
    code: int
    body: bytes
    headers: http.client.HTTPMessage

    @property
    def json(self) -> dict:
        return json.loads(self.body)


def get(server: RunsServer, path: str, **headers: str) -> Answer:
    """Ask the server for a path, literally as it is given."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    response = connection.getresponse()
    answer = Answer(response.status, response.read(), response.headers)
    connection.close()
    return answer


@pytest.fixture
def server(outputs: Path) -> Iterator[RunsServer]:
    with RunsServer(Answers(outputs, predict, 0.0), 0) as running:
        yield running


def test_runs_are_sent_again_when_anything_has_changed(server: RunsServer, outputs: Path):
    first = get(server, "/api/runs").json
    row = next(row for row in first["rows"] if row["id"] == run_of(outputs, "gru", 2).id)
    assert (len(first["rows"]), row["name"], row["status"]) == (6, "memory=gru · seed 2", "done")
    assert dict(zip(first["keys"], row["config"], strict=True))["memory.name"] == "gru"
    again = f"/api/runs?state={first['state']}"
    assert get(server, again).json == {"state": first["state"]}
    (run_of(outputs).folder / "notes.json").write_text('{"tags": ["good"]}')
    until(lambda: "rows" in get(server, again).json, "the change")
    news = get(server, again).json
    assert (news["all"], [row["tags"] for row in news["rows"]]) == (False, [["good"]])
    started_run(outputs)
    until(lambda: len(get(server, again).json["rows"]) == 7, "the new run")


def test_pages_of_a_run_a_sweep_and_curves(server: RunsServer, outputs: Path):
    run, control = run_of(outputs, "gru", 1), run_of(outputs, "none", 1)
    page = get(server, f"/api/run/{run.id}").json
    assert page["name"] == "memory=gru · seed 1"
    assert (page["control"]["id"], len(page["clips"])) == (control.id, 12)
    assert page["control"]["config"]["memory.name"] == "none"
    assert "config.yaml" in [file["name"] for file in page["files"]]
    assert get(server, "/api/sweeps").json["sweeps"][0]["title"] == "Mine"
    assert get(server, "/api/sweeps/mine").json["table"]["caption"] == "Mine"
    curves = get(server, f"/api/curves?runs={run.id},{control.id},zzz").json["curves"]
    assert {len(found["train loss"][0]) for found in curves.values()} == {21}
    assert get(server, "/api/searches").json == {"searches": []}


@pytest.mark.parametrize("path", [
    "/../../etc/passwd", "/plot/../../server.py", "/plot/%2e%2e/%2e%2e/server.py", "/server.py",
    "/api/run/" + "0" * 16,
    "/files/", "/files/{id}/", "/files/{id}/DONE", "/files/{id}/model.safetensors",
    "/files/{id}/evaluations/stream-0.json", "/files/..%2Fruns%2F{id}/config.yaml", "/files//etc/passwd",
])  # fmt: skip
def test_nothing_else_is_sent(server: RunsServer, outputs: Path, path: str):
    answer = get(server, path.replace("{id}", run_of(outputs).id))
    assert (answer.code, answer.json.keys()) == (404, {"error"})


def test_bad_questions_and_bugs_are_answers(server: RunsServer, outputs: Path, monkeypatch):
    for words in ("?mode=other&clip=c", ""):
        answer = get(server, f"/api/replay/{run_of(outputs).id}{words}")
        assert (answer.code, list(answer.json)) == (400, ["error"])
    monkeypatch.setattr(server.answers, "answer", Mock(side_effect=ZeroDivisionError("a bug")))
    answer = get(server, "/api/runs")
    assert (answer.code, answer.json) == (500, {"error": "ZeroDivisionError: a bug"})


def test_the_page_s_files_and_their_policy(server: RunsServer, outputs: Path):
    for name in FILES:
        answer = get(server, f"/{name}")
        assert (answer.code, len(answer.body) > 100) == (200, True)
    policy = answer.headers["Content-Security-Policy"]
    assert "script-src 'self' 'sha256-" in policy
    assert "unsafe-inline" not in policy.partition("style-src")[0]
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    answer = get(server, f"/files/{run_of(outputs).id}/config.yaml")
    assert (answer.code, answer.headers["Content-Type"]) == (200, "text/plain; charset=utf-8")
    assert answer.headers["Content-Security-Policy"] == "default-src 'none'; sandbox"


@pytest.mark.parametrize(("headers", "code"), [
    ({}, 200), ({"Host": "localhost:1"}, 200), ({"Host": "evil.example"}, 403),
    ({"Host": "127.0.0.1.evil.example:80"}, 403), ({"Host": ""}, 403),
    ({"Sec_Fetch_Site": "cross-site"}, 403), ({"Sec_Fetch_Site": "same-origin"}, 200),
])  # fmt: skip
def test_other_hosts_and_other_pages_get_nothing(server: RunsServer, headers: dict[str, str], code: int):
    assert get(server, "/api/runs", **headers).code == code


def post(server: RunsServer, body: object, **headers: str) -> Answer:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    given = {"X-Memmlp-Token": server.change_token} | {k.replace("_", "-"): one for k, one in headers.items()}
    connection.request("POST", "/api/change", json.dumps(body), given)
    response = connection.getresponse()
    answer = Answer(response.status, response.read(), response.headers)
    connection.close()
    return answer


def test_the_page_changes_runs_and_every_change_is_logged(server: RunsServer, outputs: Path):
    run, new = run_of(outputs), started_run(outputs)
    assert f'content="{server.change_token}"'.encode() in get(server, "/").body
    for change in (
        {"action": "name", "value": "Best"}, {"action": "tags", "value": "b a"},
        {"action": "note", "value": "x"},
        {"action": "archive"},
    ):  # fmt: skip
        assert post(server, {**change, "runs": [run.id]}).json == {}
    assert post(server, {"action": "stop", "runs": [new.id]}).code == 200
    rows = {row["id"]: row for row in get(server, "/api/runs").json["rows"]}
    shown = rows[run.id]
    assert (shown["name"], shown["tags"], shown["note"], shown["archived"]) == ("Best", ["a", "b"], "x", True)
    assert rows[new.id]["status"] == "stopped"
    logged = [json.loads(line) for line in (run.folder / "actions.jsonl").read_text().splitlines()]
    assert [(one["action"], one["by"]) for one in logged] == [
        (action, "page") for action in ("name", "tags", "note", "archive")
    ]
    assert get(server, f"/api/dependents/{run.id}").json == {"lines": ["sweep mine contains it"]}
    assert post(server, {"action": "delete", "runs": [new.id]}).code == 200
    assert not new.folder.exists()
    view = {"action": "view", "name": "Mine", "value": "filter=gru"}
    assert post(server, view).code == 200
    assert get(server, "/api/views").json == {"views": {"Mine": "filter=gru"}}
    assert post(server, {**view, "value": ""}).code == 200
    assert get(server, "/api/views").json == {"views": {}}


def test_a_change_needs_the_token_the_origin_and_a_writable_folder(server: RunsServer, outputs, monkeypatch):
    run = run_of(outputs)
    tag = {"action": "tags", "value": "good", "runs": [run.id]}
    for headers in (
        {"X_Memmlp_Token": "other"}, {"Origin": "http://evil.example"}, {"Sec_Fetch_Site": "cross-site"},
    ):  # fmt: skip
        assert post(server, tag, **headers).code == 403
    for bad in (
        [], {"action": 3}, {"action": "explode", "runs": [run.id]}, {**tag, "value": "<b>"},
        {**tag, "runs": ["0" * 16]}, {**tag, "runs": ["../x"]}, {"action": "view", "name": " "},
        {"action": "stop", "runs": [run.id]},
    ):  # fmt: skip
        answer = post(server, bad)
        assert (answer.code, list(answer.json)) == (400, ["error"])
    monkeypatch.setattr("memmlp.report.ui.server.os.access", lambda path, mode: False)
    answer = post(server, tag)
    assert (answer.code, "read-only" in answer.json["error"]) == (400, True)
    assert not (run.folder / "notes.json").exists()
    assert not (run.folder / "actions.jsonl").exists()
