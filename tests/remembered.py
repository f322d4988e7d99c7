"""What libraries would work out anew at every call is kept for all tests of a process, or of all."""

from __future__ import annotations

import contextlib
import copy
import functools
import gc
import hashlib
import importlib
import logging
import pickle
import sys
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

SILENT = "do_not_emit_stack_traces"  # torch.fx's, in newer versions


def remember() -> None:
    """Do so from now on with what is imported by now; to import it for this would cost more than it saves."""
    for name, patch in PATCHES.items():
        if name in sys.modules:
            patch(sys.modules[name])


def keep_exports(folder: Path) -> None:
    """Keep what torch's exporter makes in a folder from now on (kept_exports.py)."""
    import torch.onnx

    export = _without_extras(torch.onnx.export)

    @functools.wraps(export)
    def kept(*arguments: Any, **options: Any) -> Any:
        # Imported here, since it takes half a second that most test processes need not spend.
        from kept_exports import kept

        return kept(export, folder)(*arguments, **options)

    torch.onnx.export = kept


def _without_extras(export: Callable[..., Any]) -> Callable[..., Any]:
    """Torch's exporter without a quarter of its work: what changes nothing in the file that memmlp writes.

    It notes where in the source each node came from, which memmlp removes; it compiles Python code of each
    graph on the way, which nobody calls; it writes each down for a log, because pytest listens to it; and the
    garbage collector goes through all that it makes.
    """
    import torch.fx

    @functools.wraps(export)
    def exported(*arguments: Any, **options: Any) -> Any:
        importlib.import_module("torch.onnx._internal.exporter._compat")  # as the first export does
        remember()
        collecting, noting = gc.isenabled(), getattr(torch.fx.config, SILENT, None)
        gc.disable()
        try:
            if noting is not None:
                setattr(torch.fx.config, SILENT, True)
            with _without_code(torch.fx), _without_log("torch.__trace"):
                return export(*arguments, **options)
        finally:
            if noting is not None:
                setattr(torch.fx.config, SILENT, noting)
            if collecting:
                gc.enable()

    return exported


@contextlib.contextmanager
def _without_code(fx: Any) -> Iterator[None]:
    """Graphs that are made meanwhile have code once they are called, which the exporter's own seldom are."""
    from torch.fx._lazy_graph_module import _use_lazy_graph_module

    graphs = fx.GraphModule
    compile_now = graphs.recompile

    def compile_later(self: Any) -> None:
        def called(self: Any, *arguments: Any, **options: Any) -> Any:
            compile_now(self)
            return self(*arguments, **options)

        codegen = self.graph._codegen
        if hasattr(codegen, "pytree_info"):
            self._in_spec, self._out_spec = codegen.pytree_info.in_spec, codegen.pytree_info.out_spec
        self._code = ""
        type(self).forward = called

    graphs.recompile = compile_later
    try:
        with _use_lazy_graph_module(True):
            yield
    finally:
        graphs.recompile = compile_now


@contextlib.contextmanager
def _without_log(name: str) -> Iterator[None]:
    """Nobody listens to a logger meanwhile."""
    log = logging.getLogger(name)
    handlers, log.handlers = log.handlers, []
    try:
        yield
    finally:
        log.handlers = handlers


def _remember_values(module: Any) -> None:
    """Of torch's exporter: what a node gives, written at it, and computed anew to look at numbers' types."""
    interpreter = module._TypePromotionInterpreter
    run = interpreter.run_node
    if hasattr(run, "__wrapped__"):
        return

    @functools.wraps(run)
    def run_node(self: Any, node: Any) -> Any:
        if node.op != "call_function" or "val" not in node.meta:
            return run(self, node)
        with self._set_current_node(node):
            if rule := module.get_type_promotion_rule(node, self.type_promotion_table):
                self._maybe_promote_node(node, rule)
        return node.meta["val"]  # which changes where the node does

    interpreter.run_node = run_node


def _remember_annotations(module: Any) -> None:
    """Of torch's operators: annotations of a function that is made ten thousand times an export."""
    module.Callable = typing.Callable  # which, unlike that of collections.abc, keeps its forms


def _remember_protocols(module: Any) -> None:
    """Of Python: the members of a protocol, collected anew by each `isinstance` before Python 3.12."""
    if sys.version_info < (3, 12) and not hasattr(module._get_protocol_attrs, "cache_info"):
        module._get_protocol_attrs = functools.cache(module._get_protocol_attrs)


def _remember_exporter(module: Any) -> None:
    """Of torch's exporter: the functions that it knows and their signatures, an eighth of a small export."""
    registry = module.ONNXRegistry
    make = registry.from_torchlib.__func__
    if hasattr(make, "__wrapped__"):
        return
    known: dict[tuple[Any, ...], Any] = {}

    @functools.wraps(make)
    def from_torchlib(cls: type, *version: Any, **named: Any) -> Any:
        key = (cls, version, *named.items())
        if key not in known:
            known[key] = make(cls, *version, **named)
        made = copy.copy(known[key])
        made.functions = {target: list(kinds) for target, kinds in known[key].functions.items()}
        return made  # to which functions may be added

    registry.from_torchlib = classmethod(from_torchlib)


def _share_origins(module: Any) -> None:
    """Of torch.fx: what a node was made from, copied anew in each pass, and which memmlp never reads."""
    module.copy = types.SimpleNamespace(copy=copy.copy, deepcopy=list)


def _remember_operators(module: Any) -> None:
    """Of torch.export: which of the operators known by now are made of others, a twentieth of an export."""
    import torch

    collect = module._collect_all_valid_cia_ops
    if hasattr(collect, "__wrapped__"):
        return
    known: dict[tuple[tuple[str, int], ...], Any] = {}

    @functools.wraps(collect)
    def collected() -> Any:
        spaces = ((name, getattr(torch.ops, name)) for name in torch.ops._dir)
        key = tuple((name, len(getattr(space, "_dir", ()))) for name, space in spaces)
        if key not in known:
            known[key] = collect()
        return known[key]  # which nobody changes

    module._collect_all_valid_cia_ops = collected


def _remember_signatures(module: Any) -> None:
    """Of ONNX's operators: their signatures, made anew for each node of a graph, a tenth of an export."""
    make = module.OpSignature.from_op_schema.__func__
    if hasattr(make, "__wrapped__"):
        return
    known: dict[tuple[str, str, int], Any] = {}

    @functools.wraps(make)
    def from_op_schema(cls: type, schema: Any) -> Any:
        key = (schema.domain, schema.name, schema.since_version)
        if key not in known:
            known[key] = make(cls, schema)
        return known[key]

    module.OpSignature.from_op_schema = classmethod(from_op_schema)


def _forget_who_seeds(module: Any) -> None:
    """Of torch: who seeded an absent accelerator, said only if it were there and failed.

    Each `torch.manual_seed` writes the whole stack down three times, milliseconds below pytest.
    """
    module.traceback = types.SimpleNamespace(format_stack=list)


def _remember_interpolations(module: Any) -> None:
    """Of OmegaConf: the parts of an interpolation such as ${seed}, which it only reads."""
    if not hasattr(module.parse, "cache_info"):
        module.parse = functools.lru_cache(maxsize=1000)(module.parse)


def _remember_configs(module: Any) -> None:
    """Of Hydra: what it read of each file for as long as the file is the same, a quarter of a composition."""
    repository = module.ConfigRepository
    if hasattr(repository.load_config, "__wrapped__"):
        return
    known: dict[tuple[Any, ...], bytes] = {}

    @functools.wraps(repository.load_config)
    def load_config(self: Any, config_path: str) -> Any:
        places = tuple((type(source), source.path) for source in self.sources)
        files = [Path(place) / f"{config_path.removesuffix('.yaml')}.yaml" for _, place in places]
        key = (config_path, places, *(_stamp(file) for file in files if file.is_file()))
        if key not in known:
            known[key] = pickle.dumps(load_config.__wrapped__(self, config_path))
        return pickle.loads(known[key])  # a copy, since a composition changes what it loaded

    repository.load_config = load_config


def _remember_compositions(module: Any) -> None:
    """Of Hydra: the defaults list of the same options, each config in its package, and all of a list merged.

    A command composes three times, and what overrides then set is set anew each time.
    """
    loader, lists = module.ConfigLoaderImpl, sys.modules["hydra._internal.defaults_list"]
    if hasattr(loader._load_single_config, "__wrapped__"):
        return
    load, compose = loader._load_single_config, loader._compose_config_from_defaults_list
    choose, interpolate = lists._create_defaults_list, lists._create_interpolation_map
    stores = _counted_stores()

    @functools.wraps(choose)
    def chosen(repo: Any, config_name: Any, overrides: Any, prepend_hydra: bool, skip_missing: bool) -> Any:
        values, overrides.config_overrides = overrides.config_overrides, []  # these choose nothing
        key = ("list", overrides, config_name, prepend_hydra, skip_missing, _folders(repo), stores)
        result, state = _kept(
            key,
            lambda: (choose(repo, config_name, overrides, prepend_hydra, skip_missing), vars(overrides)),
        )
        vars(overrides).update({**state, "config_overrides": values})
        return result

    @functools.wraps(interpolate)
    def interpolated(overrides: Any, defaults_list: list[Any], self_added: bool) -> Any:
        if any(default.is_interpolation() for default in defaults_list):
            return interpolate(overrides, defaults_list, self_added)
        return None  # nobody looks at it

    @functools.wraps(compose)
    def composed(self: Any, defaults: list[Any], repo: Any) -> Any:
        repo.folders = _folders(repo), stores
        return _kept(("merged", defaults, repo.folders), lambda: compose(self, defaults, repo))

    @functools.wraps(load)
    def loaded(self: Any, default: Any, repo: Any) -> Any:
        return _kept(("one", default, repo.folders), lambda: load(self, default, repo))

    loader._load_single_config, loader._compose_config_from_defaults_list = loaded, composed
    lists._create_defaults_list, lists._create_interpolation_map = chosen, interpolated
    copied = sys.modules["hydra._internal.config_repository"].CachingConfigRepository

    def __init__(self: Any, delegate: Any) -> None:
        self.delegate, self.cache = (
            copy.copy(delegate),
            {},
        )  # it is given other sources, and never changes one

    copied.__init__ = __init__


def _kept(key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """A copy of what was made for the same key."""
    words = repr(key)
    if words not in KEPT:
        KEPT[words] = pickle.dumps(make())
    return pickle.loads(KEPT[words])


KEPT: dict[str, bytes] = {}


def _counted_stores() -> list[int]:
    """A number, from now on one more with each config that code makes known to Hydra."""
    from hydra.core.config_store import ConfigStore

    store, count = ConfigStore.store, [0]

    @functools.wraps(store)
    def counted(*arguments: Any, **options: Any) -> None:
        count[0] += 1
        store(*arguments, **options)

    ConfigStore.store = counted
    return count


def _folders(repo: Any) -> str:
    """A digest of where configs are looked for, with the stamp of each file that is there."""
    found = []
    for source in repo.get_sources():
        files = sorted(Path(source.path).rglob("*.yaml")) if source.scheme() == "file" else []
        found.append(
            (source.provider, source.scheme(), source.path, [(file, _stamp(file)) for file in files])
        )
    return hashlib.sha256(repr(found).encode()).hexdigest()


def _stamp(file: Path) -> tuple[int, int, int]:
    """When a file was written, its size, and its number on the disk."""
    status = file.stat()
    return status.st_mtime_ns, status.st_size, status.st_ino


def _remember_motion(module: Any) -> None:
    """Of synthetic motion: the poses of what a person does, six sevenths of a clip's time."""
    solve, known = module.solve, {}
    if hasattr(solve, "__wrapped__"):
        return

    @functools.wraps(solve)
    def solved(puppet: Any) -> Any:
        key = hashlib.sha256(pickle.dumps(puppet)).digest()
        if key not in known:
            known[key] = solve(puppet)
        return known[key]  # of which a clip takes copies

    module.solve = solved


PATCHES = {
    **dict.fromkeys(("torch.cuda", "torch.mtia", "torch.xpu"), _forget_who_seeds),
    "typing": _remember_protocols,
    "torch._ops": _remember_annotations,
    "torch.onnx._internal.exporter._registration": _remember_exporter,
    "torch.onnx._internal.fx.passes.type_promotion": _remember_values,
    "torch.fx.traceback": _share_origins,
    **dict.fromkeys(("torch.export.exported_program", "torch.export.decomp_utils"), _remember_operators),
    "onnx_ir.schemas": _remember_signatures,
    "omegaconf.base": _remember_interpolations,
    "hydra._internal.config_repository": _remember_configs,
    "hydra._internal.config_loader_impl": _remember_compositions,
    "memmlp.motion.synthetic": _remember_motion,
}
