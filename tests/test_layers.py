"""The layers of the package: CI checks their order with import-linter, and here no import may close a circle."""

import graphlib
from pathlib import Path

import grimp
import pytest

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def imports():
    """Every module with the modules of the package that it imports, under ``TYPE_CHECKING`` or not."""
    graph = grimp.build_graph("sb3_flock", exclude_type_checking_imports=False, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


@pytest.fixture(scope="module")
def linter():
    """The configuration of import-linter."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]


def circle(imports):
    """Modules that import each other in a circle; empty if there are none."""
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_no_import_closes_a_circle_of_modules(imports):
    assert len(imports) > 70
    assert circle(imports) == []


def test_no_import_closes_a_circle_of_packages(imports):
    """A package may import its sibling only if the sibling does not import the package, at every depth."""
    for package in imports:
        below = f"{package}."
        children = {}
        for module, targets in imports.items():
            if module.startswith(below):
                own = module.removeprefix(below).split(".")[0]
                found = {target.removeprefix(below).split(".")[0] for target in targets if target.startswith(below)}
                children.setdefault(own, set()).update(found - {own})
        assert circle(children) == [], package


def test_a_circle_is_found():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})) == {"a", "b", "c"}


def test_nothing_inside_imports_the_public_names(imports):
    """``from sb3_flock import X`` inside the package would import from the top of it."""
    assert [module for module, targets in imports.items() if "sb3_flock" in targets] == []


def test_every_module_has_a_layer_and_the_contract_has_no_exceptions(linter):
    (contract,) = linter["contracts"]
    assert contract["type"] == "layers"
    assert contract["exhaustive"] is True
    assert "ignore_imports" not in contract
    assert "exhaustive_ignores" not in contract
    assert "exclude_type_checking_imports" not in linter  # the default counts them
    listed = {name.strip() for layer in contract["layers"] for name in layer.split("|")}
    package = ROOT / "sb3_flock"
    modules = {path.stem for path in package.glob("*.py")} | {path.parent.name for path in package.glob("*/__init__.py")}
    assert listed == modules - {"__init__"}


def test_every_folder_with_modules_is_a_package():
    folders = {path.parent for path in (ROOT / "sb3_flock").rglob("*.py")}
    assert [folder for folder in folders if not (folder / "__init__.py").exists()] == []


def test_each_module_has_a_test_of_its_name():
    package = ROOT / "sb3_flock"
    modules = [path.relative_to(package) for path in package.rglob("*.py") if not path.name.startswith("__")]
    missing = [
        str(module)
        for module in modules
        if not (ROOT / "tests" / module.parent / f"test_{module.name.lstrip('_')}").exists()
    ]
    assert missing == []
