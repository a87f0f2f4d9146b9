"""A cloud that is in no file, as text of a grasp file: an object that was taken out of a scene."""

from __future__ import annotations

import base64
import io
import zipfile
from typing import TYPE_CHECKING

import numpy as np

from dro_grasp.errors import ObjectError

if TYPE_CHECKING:
    from dro_grasp.objects.shape import ObjectModel

LONGEST = 10_000_000  # Longest text that is read (ours): twenty times that of the largest cloud


def packed_cloud(obj: ObjectModel) -> str:
    """Points, normals, what was seen of them, and the table below, of a bare cloud: NPZ in base64."""
    arrays = {"cloud": obj.cloud, "normals": obj.cloud_normals}
    arrays |= {} if obj.seen is None else {"seen": obj.seen}
    arrays |= {} if obj.table is None else {"table": obj.table}
    np.savez_compressed(file := io.BytesIO(), **arrays)  # type: ignore[arg-type]
    return base64.b64encode(file.getvalue()).decode()


def unpacked_cloud(text: str, name: str) -> ObjectModel:
    """The object as it was packed.

    Raises:
        ObjectError: The text is none that `packed_cloud` writes.
    """
    from dro_grasp.geometry.cache import content_hash
    from dro_grasp.objects.shape import ObjectModel

    try:
        if len(text) > LONGEST:
            raise ValueError(f"{len(text)} characters")
        with np.load(io.BytesIO(base64.b64decode(text, validate=True)), allow_pickle=False) as arrays:
            held = {key: arrays[key] for key in arrays.files}
        cloud, normals, seen, table = held["cloud"], held["normals"], held.get("seen"), held.get("table")
        shapes = [rows.shape == (len(rows), 3) for rows in (cloud, normals, *([] if seen is None else [seen]))]
        if not all(shapes) or len(cloud) != len(normals) or (table is not None and table.shape != (4,)):
            raise ValueError("arrays of other shapes")
        if not all(np.isfinite(array).all() for array in held.values()):
            raise ValueError("numbers that are not finite")
    except (ValueError, KeyError, OSError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ObjectError(f"the cloud of object '{name}' in the grasp file is damaged ({error}); make the grasps again, or "
                          "give the object's file with object=...") from error
    note = f"bare point cloud of {len(cloud)} points, as taken: no trial is possible without a mesh"
    return ObjectModel(
        name, cloud.astype(np.float32), normals.astype(np.float32), cloud.mean(0, dtype=np.float64), content_hash(cloud),
        table=table, seen=seen, notes=(note,))
