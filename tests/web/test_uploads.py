"""Files that are sent: they read only what was sent with them, and harm nothing."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

from dro_grasp.errors import OptionError
from dro_grasp.web.uploads import MAX_BYTES, store_upload
from tests.helpers.claw_urdf import claw, meshed


def zipped(**files: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return file.getvalue()


def test_a_zip_file_is_unpacked_and_its_description_found(tmp_path: Path) -> None:
    content = zipped(**{"hand/mine.urdf": b"<robot/>", "hand/meshes/a.stl": b"1", "other.xml": b"<x/>"})
    assert store_upload("mine.zip", content, tmp_path) == tmp_path / "hand" / "mine.urdf"
    assert (tmp_path / "hand" / "meshes" / "a.stl").read_bytes() == b"1"


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("a.urdf", b"x" * (MAX_BYTES + 1), "limit is 20"), ("..", b"", "not a file name"),
        ("a\0b.stl", b"", "not a file name"), ("\u00e9" * 101 + ".stl", b"", "of 1 to 200 bytes"),
        ("a.zip", b"no zip", "expected a ZIP file"), ("a.zip", zipped(**{"../evil.urdf": b"x"}), "outside the archive"),
        ("a.zip", zipped(**{"/evil.urdf": b"x"}), "outside the archive"),
        ("a.zip", zipped(**{"a.stl": b"x"}), "no URDF or MJCF"),
        ("a.zip", zipped(**{f"{i}.urdf": b"" for i in range(1001)}), "1001 files"),
    ],
)
def test_uploads_that_could_harm_are_refused(name: str, content: bytes, word: str, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    with pytest.raises(OptionError, match=word):
        store_upload(name, content, folder)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("name", ["/etc/passwd", "../other/x.stl", "package://secret/x.stl", "file:///etc/passwd", "~/x.stl"])
def test_an_uploaded_description_reads_only_what_was_uploaded(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "uploads" / "2"
    for other in ("secret", "uploads/other"):
        (tmp_path / other).mkdir(parents=True)
        (tmp_path / other / "x.stl").write_bytes(b"x")
    folder.mkdir()
    with pytest.raises(OptionError, match="was not uploaded with it"):
        store_upload("hand.urdf", meshed(name).encode(), folder)


@pytest.mark.parametrize("text", [
    '<mujoco><include file="a.xml"/></mujoco>', '<mujoco><asset><model name="m" file="a.xml"/></asset></mujoco>'])
def test_an_uploaded_description_includes_nothing(tmp_path: Path, text: str) -> None:
    with pytest.raises(OptionError, match="which uploads may not"):
        store_upload("hand.xml", text.encode(), tmp_path)


@pytest.mark.parametrize(
    "text", ['<mujoco><compiler meshdir="/etc"/></mujoco>', '<mujoco><compiler assetdir="../.."/></mujoco>'])
def test_an_uploaded_description_names_no_other_folder(tmp_path: Path, text: str) -> None:
    with pytest.raises(OptionError, match="was not uploaded with it"):
        store_upload("hand.xml", text.encode(), tmp_path)


def test_an_upload_of_several_files_is_taken(tmp_path: Path) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("hand/hand.urdf", meshed("package://hand/x.obj"))
        archive.writestr("hand/x.obj", "v 0 0 0\n")
    assert store_upload("hand.zip", packed.getvalue(), tmp_path).name == "hand.urdf"
    assert store_upload("claw.urdf", claw().encode(), tmp_path).name == "claw.urdf"
