"""What a camera saw, from files: its pose and intrinsics, depth images and clouds."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Num, Shaped
from PIL import Image

from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.files import given_path, reading
from dro_grasp.frames import is_name, motion_fault, read_motion
from dro_grasp.geometry.mesh_files import check_bytes
from dro_grasp.kinds import is_number
from dro_grasp.objects.perception.choosing import Sight
from dro_grasp.objects.perception.scan import NEAREST, check_depths, check_intrinsics, refuse_behind
from dro_grasp.objects.reading import IMAGES, is_image, numbers, one_channel, read_cloud, returned

WHOLE_UNIT = 0.001  # Unit of depths that are whole numbers [m]. Source: REP 118, ROS


@dataclass(frozen=True, eq=False)
class SceneCamera:
    """The camera that saw a scene."""

    T_frame_camera: Float[np.ndarray, "4 4"]
    """Its pose [m]; z points forward, x right, y down."""
    intrinsics: Float[np.ndarray, "3 3"] | None = None
    """Pinhole matrix [pixels]; needed for depth images and for pixels."""
    frame: str = "camera"
    """Name of the frame."""
    depth_unit: float | None = None
    """Unit of depth images [m]; by default a millimetre for whole numbers, else a metre."""

    def __post_init__(self) -> None:
        """Refuse impossible settings, by an OptionError; arrays of something else than numbers by an ObjectError."""
        T = numbers(self.T_frame_camera, "T_frame_camera").astype(np.float64)
        if (fault := motion_fault(torch.from_numpy(T))) is not None:
            raise OptionError(f"T_frame_camera is not the camera's pose in the frame '{self.frame}', in metres: {fault}")
        if not is_name(self.frame):
            raise OptionError(f"frame is {self.frame!r}; expected a name on one line")
        T[3] = 0, 0, 0, 1
        object.__setattr__(self, "T_frame_camera", T)
        if self.intrinsics is not None:
            K = numbers(self.intrinsics, "the matrix of intrinsics").astype(np.float64)
            if K.shape != (3, 3) or not np.isfinite(K).all():
                raise OptionError(f"intrinsics have shape {K.shape}; give 3 rows of 3 finite numbers, in pixels")
            object.__setattr__(self, "intrinsics", K)
        if self.depth_unit is not None and not (is_number(self.depth_unit) and 0 < self.depth_unit <= 1):
            raise OptionError(f"depth_unit is {self.depth_unit!r}; give the metres of one count, such as 0.001")


def as_camera(camera: SceneCamera | Path | str) -> SceneCamera:
    """A camera, or the one of a JSON file `{"frame", "T_frame_camera", "intrinsics", "depth_unit"}`, the last two optional.

    OptionError: the file cannot be read, or holds something else.
    """
    if isinstance(camera, SceneCamera):
        return camera
    path, motion = given_path(camera), read_motion(Path(camera), "T_frame_camera")
    values = json.loads(path.read_text())  # read above
    K, unit = values.get("intrinsics"), values.get("depth_unit")
    if unit is not None and not is_number(unit):
        raise OptionError(f"{path} has depth_unit {unit!r}; give the metres of one count, such as 0.001")
    if K is not None:
        try:
            K = np.array(K, np.float64)
        except (ValueError, TypeError) as error:
            raise OptionError(f"{path} has intrinsics that are no matrix ({error}); give 3 rows of 3 numbers, in "
                              "pixels") from error
        if K.shape != (3, 3):
            raise OptionError(f"{path} has intrinsics of shape {K.shape}; give 3 rows of 3 numbers, in pixels")
    return SceneCamera(motion.T.double().numpy(), K, motion.frame, None if unit is None else float(unit))


def is_depth(source: Path | Shaped[np.ndarray, "..."]) -> bool:
    """Whether a file or an array is a depth image, and no cloud."""
    if isinstance(source, np.ndarray):
        return is_image(source)
    if source.suffix.lower() != ".npy":
        return source.suffix.lower() in IMAGES
    return is_depth(_array(source))


def _array(path: Path) -> Num[np.ndarray, "..."]:
    read_cloud(path)  # which says what is wrong with it
    return np.load(path, allow_pickle=False)


def read_depth(path: Path, camera: SceneCamera | None) -> Num[np.ndarray, "h w *channel"]:
    """Depths of a file, in its unit."""
    if path.suffix.lower() == ".npy":
        return _array(path)
    with reading(path, ObjectError, "a depth image: PNG of 16 bit or TIFF, with one channel", Exception):
        check_bytes(path)
        with Image.open(path) as image:
            depth = np.array(image)
    if depth.ndim != 2 or depth.dtype == np.uint8:
        raise ObjectError(f"{path} has {'colours' if depth.ndim == 3 else '8 bit a pixel'}, and is no depth image; expected "
                          "one channel of 16 bit (PNG) or of floats (TIFF, NPY), along the camera's z")
    return depth


def read_mask(path: Path) -> Bool[np.ndarray, "h w"]:
    """A mask's pixels: not 0 on the object; of a JPEG, which blurs edges, the brighter half."""
    path = given_path(path)
    with reading(path, ObjectError, "a PNG that is not black on the object alone", Exception):
        check_bytes(path)
        with Image.open(path) as image:
            if image.format == "JPEG":
                return np.array(image.convert("L")) > 127
            if image.mode in ("1", "L", "I", "I;16", "F"):
                return np.array(image) != 0
            pixels = np.array(image.convert("RGBA"))
            return pixels[..., :3].any(-1) & (pixels[..., 3] > 0)


def sight_of_depth(depth: Num[np.ndarray, "..."], camera: SceneCamera | None, scale: float, origin: str) -> Sight:
    """The points of a depth image, with their pixels."""
    if camera is None or camera.intrinsics is None:
        raise OptionError(f"{origin} is a depth image; give its camera with intrinsics: a JSON file {{\"frame\": NAME, "
                          "\"T_frame_camera\": 4x4, \"intrinsics\": 3x3}")
    image = one_channel(numbers(depth, origin))
    height, width = image.shape
    check_intrinsics(camera.intrinsics, height, width)
    unit = camera.depth_unit or (WHOLE_UNIT if image.dtype.kind in "iu" else 1.0)
    image = image.astype(np.float64) * (unit * scale)
    with np.errstate(invalid="ignore"):
        pixels = np.flatnonzero((np.isfinite(image) & (image > 0)).ravel())
    if not len(pixels):
        raise ObjectError(f"no pixel of {origin} has a depth; give depths along z, and 0 or NaN for none")
    z = image.ravel()[pixels]
    check_depths(float(np.median(z)), scale)
    row, column = np.divmod(pixels, width)
    rays = np.linalg.solve(camera.intrinsics, np.stack([column, row, np.ones_like(row)]).astype(np.float64))
    return Sight((rays / rays[2] * z).T, camera.T_frame_camera, True, pixels, (height, width), camera.intrinsics)


def sight_of_cloud(points: Float[np.ndarray, "n 3"], camera: SceneCamera | None, shape: tuple[int, int] | None) -> Sight:
    """The points of a cloud [m]; an organised one has pixels. ObjectError: it is not in metres."""
    kept = np.flatnonzero(returned(points))
    if len(kept) and camera is not None and (away := float(np.median(np.linalg.norm(points[kept], axis=1)))) < NEAREST:
        raise ObjectError(f"the points of the cloud are {away:.3g} m from the camera, nearer than a depth camera measures "
                          f"({NEAREST:g} m); give them in metres, in the frame of the camera")
    if camera is not None:
        refuse_behind(points[kept], "the cloud has")
    T = np.eye(4) if camera is None else camera.T_frame_camera
    return Sight(points[kept], T, camera is not None, kept, shape, None if camera is None else camera.intrinsics)
