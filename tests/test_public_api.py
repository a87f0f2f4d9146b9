"""The names that people import, and what importing them costs."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import dro_grasp as dro
from tests.helpers.weights import untrained_weights

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
STUB = [node for node in ast.parse(Path(dro.__file__).with_suffix(".pyi").read_text()).body if isinstance(node, ast.ImportFrom)]
NAMES = sorted(set(dro.__all__) - {"__version__"})


def test_every_public_name_has_a_docstring_of_its_own() -> None:
    without = []
    for name in NAMES:
        value = getattr(dro, name)
        # A dataclass without a docstring gets its signature, a subclass its parent's.
        own = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
        if not own or own.startswith(f"{name}("):
            without.append(name)
    assert without == []


def test_the_list_of_names_states_each_once_and_for_type_checkers() -> None:
    aliases = [alias for node in STUB for alias in node.names]
    assert all(alias.asname == alias.name for alias in aliases), "a type checker takes only an import with an alias for public"
    assert sorted(alias.name for alias in aliases) == sorted(dro.__all__) == dir(dro), "a name is stated twice"


def test_the_list_names_the_module_that_defines_each() -> None:
    for node in STUB:
        for alias in node.names:
            if alias.name != "__version__":
                assert getattr(dro, alias.name).__module__ == f"dro_grasp.{node.module}"


def test_the_package_shows_its_public_names_only_before_and_after_their_use() -> None:
    code = ("import dro_grasp as dro; known = set(dir(dro)); dro.load_hand; assert set(dir(dro)) == known == set(dro.__all__); "
            "print(*[n for n in vars(dro) if not n.startswith('_')])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {"load_hand"} <= set(done.stdout.split()) <= known_rooms() | {"load_hand"}, "no module that the package itself needs"


def known_rooms() -> set[str]:
    """Modules and packages of the package, which appear in it once something in them was loaded."""
    return {path.stem for path in Path(dro.__file__).parent.iterdir()}


def test_the_python_page_documents_every_public_name_and_no_other() -> None:
    documented = re.findall(r"^::: dro_grasp\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted(documented) == NAMES


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_examples_import_the_package_alone(path: Path) -> None:
    tree = ast.parse(path.read_text())
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    assert {name for name in imported if name.partition(".")[0] == "dro_grasp"} == {"dro_grasp"}
    used = {node.attr for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "dro"}
    assert used
    assert used <= set(dro.__all__)


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="nothing_such"):
        _ = dro.nothing_such


@pytest.mark.parametrize("module", ["dro_grasp", "dro_grasp.cli.main"])
def test_neither_the_package_nor_the_command_loads_libraries_before_they_are_used(module: str) -> None:
    code = f"import sys, {module}; print(sorted({{'torch', 'numpy', 'scipy', 'mujoco', 'trimesh'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_hand_in_object_in_grasps_out(tmp_path: Path) -> None:
    hand = dro.load_hand("gripper3")
    obj = dro.load_object("sphere")
    predictor = dro.GraspPredictor(str(untrained_weights(tmp_path)))
    grasps = predictor.predict(hand, obj, num=4)
    result = dro.simulate(hand, obj, grasps)
    evaluated = grasps.with_trial(result)
    assert dro.evaluate(dro.GraspProblem(hand, obj), grasps).protocol == evaluated.protocol == ("carry/1",) * 4
    chosen = evaluated[evaluated.success]
    assert len(chosen) == int(result.success.sum())
    evaluated.save(tmp_path / "grasps.parquet")
    again = dro.GraspBatch.load(tmp_path / "grasps.parquet")
    assert (again.joints == evaluated.joints).all()
    assert len(evaluated.to_pandas()) == 4
