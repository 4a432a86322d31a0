"""Rules of the house that a machine can check: layers, kernels, names."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from solvers import SOLVERS

ROOT = Path(__file__).resolve().parent.parent
# Each imports only itself and what stands to its left.
LAYERS = ("solvers", "scenarios", "harness", "reports")
FORBIDDEN_MODULES = {"utils", "common", "base", "types", "helpers"}
FORBIDDEN_NAMES = {"lam", "vel", "num_x", "data", "info", "tmp"}


def modules(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def imported(tree: ast.AST) -> set[str]:
    """Top-level names that a module imports, wherever the import stands."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("layer", LAYERS)
def test_each_layer_imports_only_itself_and_what_stands_to_its_left(layer: str) -> None:
    to_the_right = {*LAYERS[LAYERS.index(layer) + 1 :], "impactbench", "tests"}
    for path in modules(layer):
        wrong = imported(ast.parse(path.read_text())) & to_the_right
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def is_kernel(function: ast.FunctionDef) -> bool:
    return any(
        isinstance(decorator, ast.Name) and decorator.id in ("kernel", "parallel_kernel")
        for decorator in function.decorator_list
    )


def kernels(tree: ast.Module) -> list[ast.FunctionDef]:
    return [node for node in tree.body if isinstance(node, ast.FunctionDef) and is_kernel(node)]


def made_alone(tree: ast.Module, own: set[str]) -> set[str]:
    """Names of a module's own kernels compiled once more, for one thread."""
    return {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
        if isinstance(node.value.func, ast.Name) and node.value.func.id == "alone"
        if all(isinstance(kernel, ast.Name) and kernel.id in own for kernel in node.value.args)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


ALL_MODULES = [path for layer in LAYERS for path in modules(layer)]
BUILTINS = {"range", "prange", "len", "min", "max", "abs", "float", "int", "bool"}


@pytest.mark.parametrize("path", ALL_MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_kernel_calls_kernels_of_its_own_file_only(path: Path) -> None:
    # numba's cache does not see edits in another file: a stale kernel would go on silently.
    tree = ast.parse(path.read_text())
    own = {function.name for function in kernels(tree)}
    own |= made_alone(tree, own)
    for function in kernels(tree):
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                allowed = node.func.id in own or node.func.id in BUILTINS
                assert allowed, f"{path.name}: kernel {function.name} calls {node.func.id}"


@pytest.mark.parametrize("path", ALL_MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_kernels_hold_no_string_exception_or_print(path: Path) -> None:
    for function in kernels(ast.parse(path.read_text())):
        body = function.body[1:] if ast.get_docstring(function) else function.body
        for statement in body:
            for node in ast.walk(statement):
                assert not isinstance(node, ast.Raise | ast.Try | ast.JoinedStr), f"{path.name}: {function.name}"
                assert not (isinstance(node, ast.Constant) and isinstance(node.value, str)), function.name


def test_numba_is_configured_in_one_place() -> None:
    for path in ALL_MODULES:
        if path.name != "_jit.py":
            assert "numba" not in imported(ast.parse(path.read_text())), path.relative_to(ROOT)


def test_no_module_is_a_catch_all() -> None:
    assert not FORBIDDEN_MODULES & {path.stem for path in ALL_MODULES}


@pytest.mark.parametrize("path", ALL_MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_names_are_the_words_of_the_field(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        name = node.id if isinstance(node, ast.Name) else node.arg if isinstance(node, ast.arg) else ""
        assert name not in FORBIDDEN_NAMES, f"{path.relative_to(ROOT)} uses {name}"


def swallows_everything(node: ast.AST) -> bool:
    """An exception handler for everything that does not raise again what it caught."""
    if not isinstance(node, ast.ExceptHandler):
        return False
    broad = node.type is None or (isinstance(node.type, ast.Name) and node.type.id in ("Exception", "BaseException"))
    last = node.body[-1]
    return broad and not (isinstance(last, ast.Raise) and last.exc is None)


def test_only_the_isolation_boundary_swallows_every_exception() -> None:
    for path in [*ALL_MODULES, ROOT / "impactbench.py"]:
        if path.name != "isolation.py":
            for node in ast.walk(ast.parse(path.read_text())):
                assert not swallows_everything(node), path.relative_to(ROOT)


def test_solvers_are_registered_in_alphabetical_order() -> None:
    assert list(SOLVERS) == sorted(SOLVERS)


def test_every_solver_is_a_frozen_dataclass_with_documented_settings() -> None:
    for name, law in SOLVERS.items():
        assert law.__dataclass_params__.frozen, name  # type: ignore[attr-defined]
        assert law.__doc__, name
        assert law() == law(), name
        assert hash(law()) == hash(law()), name
