"""The folder of constraints: what its fields ask for, what they show, and what they refuse."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import trimesh
import viser

from dro_grasp.apps.viewer.constraint_panel import NOTHING
from dro_grasp.apps.viewer.studio import Studio
from dro_grasp.objects.catalogue import load_object
from dro_grasp.predict.constraints import Constraints
from tests.helpers.served_studio import Listener, asked, served_studio

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning", "default::ResourceWarning")


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory):
    with served_studio(tmp_path_factory.mktemp("weights"), Listener) as made:
        yield made


def test_fields_become_constraints_and_are_drawn(studio: Studio) -> None:
    assert asked(studio)[0].constraints == Constraints(), "empty fields ask for nothing"
    panel, low = studio.panel, float(load_object("sphere").cloud[:, 2].min())
    studio._table_under()
    panel.direction.value, panel.max_tilt.value, panel.pregrasp_clearance.value = "-z", "30", "8"
    panel.contact_region.value, panel.keep_out.value = "0 0 0.02 0.05; 0.02, 0, 0, 0.03", "0 0 -0.06 0.02"
    file = io.BytesIO()
    trimesh.creation.box(extents=(0.2, 0.2, 0.02), transform=trimesh.transformations.translation_matrix([0.2, 0, 0])).export(
        file, file_type="stl")
    upload = viser.UploadedFile(name="shelf.stl", content=file.getvalue())
    studio._take(upload, "scene", studio.panel.obstacles, studio._draw_constraints)
    studio._draw_constraints()
    parts = "table", "contact_region0", "contact_region1", "contact_region2", "keep_out0", "keep_out1", "obstacles"
    drawn = [name for name in parts
             if studio.client.scene.get_handle_by_name(f"/constraints/{name}") is not None]
    assert drawn == ["table", "contact_region0", "contact_region1", "keep_out0", "obstacles"]
    found = asked(studio)[0].constraints
    assert found.direction == (0.0, 0.0, -1.0)
    assert found.max_tilt == pytest.approx(math.radians(30))
    assert found.table == pytest.approx(low, abs=1e-4)
    assert found.contact_region == ((0.0, 0.0, 0.02, 0.05), (0.02, 0.0, 0.0, 0.03))
    assert found.keep_out == ((0.0, 0.0, -0.06, 0.02),)
    assert found.pregrasp_clearance == pytest.approx(0.008)
    assert found.obstacles is not None
    assert found.obstacles.name == "shelf"
    panel.obstacles.value = NOTHING
    assert asked(studio)[0].constraints.obstacles is None


def test_a_stated_mass_is_the_objects(studio: Studio) -> None:
    usual = load_object("sphere").mass
    for text, mass in (("", usual), ("0.4", 0.4), ("", usual)):
        studio.mass.value = text
        assert asked(studio)[0].mass == pytest.approx(mass), text
    for text, message in (("heavy", "is 'heavy', which holds something else than numbers"), ("0.1 0.2", "give one number"),
                          ("-1", "mass is -1.0; give kilograms"), ("300", "300 g are 0.3 kg")):
        studio.mass.value = text
        studio._guarded(studio._generate)
        assert studio.status.content.startswith("**Error:**")
        assert message in studio.status.content
    studio.mass.value = ""


@pytest.mark.parametrize(("field", "text", "message"), [
    ("table", "high", "something else than numbers"), ("table", "0 1", "give one number"),
    ("contact_region", "0 0 0", "give x y z radius"), ("max_tilt", "200", "max_tilt is 3.49"),
])
def test_what_no_constraint_can_be_is_told(studio: Studio, field: str, text: str, message: str) -> None:
    control = getattr(studio.panel, field)
    before, control.value = control.value, text
    studio.panel.direction.value = "-z"
    studio._guarded(studio._draw_constraints)
    assert studio.status.content.startswith("**Error:**")
    assert message in studio.status.content
    control.value = before


def test_the_things_of_a_scene_can_be_picked_and_all_else_is_avoided(studio: Studio) -> None:
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.004), np.arange(-0.3, 0.3, 0.004))
    parts = [np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)]
    for middle in ((0.2, 0.1), (-0.2, -0.1)):
        box = trimesh.creation.box((0.06, 0.06, 0.1), trimesh.transformations.translation_matrix([*middle, 0.05]))
        parts.append(np.asarray(trimesh.sample.sample_surface(box, 4000, seed=0)[0]))
    np.save(file := io.BytesIO(), np.concatenate(parts))
    before, panel = studio.object.value, studio.panel
    panel.contact_region.value = panel.keep_out.value = panel.table.value = ""
    upload = viser.UploadedFile(name="desk.npy", content=file.getvalue())
    studio._take(upload, "scene", panel.obstacles, studio._draw_constraints)
    assert studio.object.value == "thing 1 of desk.npy"
    for k in (1, 2):
        studio.object.value = f"thing {k} of desk.npy"
        studio._pick_object()
        obj, found = asked(studio)[0].obj, asked(studio)[0].constraints.obstacles
        assert found is not None
        own, other = sorted(((0.2, 0.1), (-0.2, -0.1)), key=lambda m: float(np.linalg.norm(obj.cloud[:, :2].mean(0) - m)))
        assert np.linalg.norm(obj.cloud[:, :2].mean(0) - own) < 0.01
        assert np.linalg.norm(found.points[:, :2] - other, axis=1).min() < 0.05
        assert np.linalg.norm(found.points[:, :2] - own, axis=1).min() > 0.1
        assert studio.client.scene.get_handle_by_name("/constraints/obstacles") is not None
    studio.object.value = before
    studio._pick_object()
    assert panel.obstacles.value == NOTHING
