"""Planted faults: where each goes, which tests are near it, and what is read from a report of pytest."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lab.mutations import FAULTS, PLANTED, ROOT, Fault, failures, near

REPORT = """<testsuites><testsuite>
<testcase name="test_good" file="tests/a/test_b.py"/>
<testcase name="test_bad[1-x]" file="tests/a/test_b.py"><failure message="m">t</failure></testcase>
<testcase name="tests.a.test_c"><error message="collection failure">t</error></testcase>
</testsuite></testsuites>"""


def test_a_fault_is_planted_at_one_place(tmp_path: Path) -> None:
    file = tmp_path / "src" / "dro_grasp" / "a" / "b.py"
    file.parent.mkdir(parents=True)
    file.write_text("x = 1\ny = x + 1\n")
    Fault("a/b.py", "x + 1", "x - 1", "a sign").plant(tmp_path)
    assert file.read_text() == "x = 1\ny = x - 1\n"
    for text in ("x + 1", "x"):
        with pytest.raises(ValueError, match="times; expected once"):
            Fault("a/b.py", text, "", "nothing").plant(tmp_path)


def test_tests_near_a_fault_are_those_of_its_folder_and_those_that_import_it() -> None:
    files = {"tests/a/test_b.py": "", "tests/a/test_a.py": "", "tests/test_z.py": "from dro_grasp.a.b import x\n",
             "tests/test_y.py": "from dro_grasp.a.bc import x\n", "tests/test_x.py": "from dro_grasp.a import b\n"}
    assert near(Fault("a/b.py", "", "", ""), files) == [
        ["tests/a/test_b.py", "tests/a/test_a.py"], ["tests/test_x.py", "tests/test_z.py"]]
    assert near(Fault("a/deeper/c.py", "", "", ""), files)[0] == ["tests/a/test_a.py", "tests/a/test_b.py"]
    assert near(Fault("z.py", "", "", ""), files) == [["tests/test_z.py"], []]


def test_failures_and_modules_that_are_not_imported_are_read_from_a_report(tmp_path: Path) -> None:
    (tmp_path / "report.xml").write_text(REPORT)
    assert list(failures(tmp_path / "report.xml")) == ["tests/a/test_b.py::test_bad[1-x]", "tests/a/test_c.py"]


@pytest.mark.skipif(PLANTED in os.environ, reason="each planted fault would be found by this")
def test_the_faults_fit_the_code() -> None:
    for fault in FAULTS:
        assert (ROOT / "src" / "dro_grasp" / fault.path).read_text().count(fault.text) == 1, fault.breaks


def test_there_are_thirty_faults_over_the_core_of_the_package() -> None:
    assert len({fault.breaks for fault in FAULTS}) == len(FAULTS) == 30
    assert all(fault.text != fault.planted for fault in FAULTS)
    assert {Path(fault.path).parts[0] for fault in FAULTS} == {
        "geometry", "hands", "objects", "network", "distance_matrix.py", "grasps", "optimize", "simulation", "predict",
        "files.py", "compare", "training"}
