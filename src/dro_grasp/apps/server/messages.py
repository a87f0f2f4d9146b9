"""What a grasp server is asked and what it answers, as JSON: the one place where both are defined."""

from __future__ import annotations

import ast
import base64
import inspect
import textwrap
import uuid
from dataclasses import MISSING, fields
from itertools import pairwise
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, create_model, field_validator, model_validator

from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints

MAX_POINTS = 200_000  # Most points of a cloud that is sent as numbers (ours); files may hold more


def no_truth(given: Any) -> Any:
    """What is given; true and false are no numbers, although Python counts with them."""
    if isinstance(given, bool):
        raise ValueError(f"{str(given).lower()} is no number; give one")
    return given


Number = Annotated[float, BeforeValidator(no_truth)]
Point = tuple[Number, Number, Number]
Row = tuple[Number, Number, Number, Number]
Settings = TypeVar("Settings")


class Message(BaseModel):
    """A JSON object; what is not named here is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, ser_json_bytes="base64")


class SentFile(Message):
    """A file that travels within the request."""

    name: str = Field(max_length=200)
    """Its name; the suffix tells the format."""
    content: bytes = Field(json_schema_extra={"contentEncoding": "base64"})
    """The bytes, in base64."""

    @field_validator("content", mode="before")
    @classmethod
    def _decoded(cls, given: Any) -> bytes:
        if not isinstance(given, str | bytes):
            raise ValueError("content is no text; give the file's bytes in base64")
        return base64.b64decode(given, validate=True)


class SentObject(Message):
    """An object: one of name, file and points. A text instead is its name."""

    name: str | None = None
    """Name of an object that the server knows."""
    file: SentFile | None = None
    """A mesh or cloud file, whole; it cannot name other files."""
    points: list[Point] | None = Field(None, max_length=MAX_POINTS)
    """A point cloud [m]."""
    scale: Number = 1.0
    """Multiplies the coordinates; 0.001 for millimetres."""
    keep_table: bool = False
    """Take every point of a cloud for the object's; by default a table in it is found and cut off."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, given: Any) -> Any:
        return {"name": given} if isinstance(given, str) else given

    @model_validator(mode="after")
    def _one_source(self) -> SentObject:
        if sum(source is not None for source in (self.name, self.file, self.points)) != 1:
            raise ValueError("give one of name, file and points")
        return self


class SentCamera(Message):
    """The camera that saw a cloud; the grasps are in the named frame, and so are direction and table."""

    frame: str = Field(min_length=1, max_length=200)
    """Name of the frame."""
    T_frame_camera: tuple[Row, Row, Row, Row]
    """The camera's pose in it [m]."""
    intrinsics: tuple[Point, Point, Point] | None = None
    """Pinhole matrix [pixels]; needed for depth images and for pixels."""
    depth_unit: Number | None = Field(None, gt=0, le=1)
    """Unit of a depth image [m]; by default a millimetre for whole numbers, else a metre."""


class SentChoice(Message):
    """Which thing of a scene is the object: one of the four, or none where there is one thing alone."""

    at: Point | None = None
    """A place on it, in the frame of the grasps [m]."""
    pixel: tuple[Number, Number] | None = None
    """A pixel that shows it: column and row."""
    nearest: bool = False
    """Take the one nearest to the camera."""
    part: bool = False
    """Of things that touch, take the one side at the place or the pixel."""
    mask: SentFile | None = None
    """A PNG of the image's size that is not black on the object alone."""


class _Call(Message):
    hand: str
    """Name of a hand that the server knows."""
    object: SentObject
    """What to grasp."""
    mass: Number | None = None
    """Mass of the object [kg], which the grasps shall carry; null for density times volume."""
    choose: SentChoice | None = None
    """The object is a scene, a cloud or a depth image (PNG, TIFF, NPY), of which one thing is meant; all else is avoided."""
    camera: SentCamera | None = None
    """Where the cloud was seen from; without one, it is taken to be in the frame of the grasps."""
    protocol: str | None = None
    """Evaluate each grasp in simulation under this protocol, which needs a mesh; by default grasps get no trial."""
    id: str = Field(default_factory=lambda: uuid.uuid4().hex, max_length=64, pattern=r"^[\w-]+$")
    """Name of the request, by which it can be cancelled."""


WIRE_TYPES: dict[str, Any] = {"obstacles": SentObject | None, "source": Literal["auto", "network", "optimiser"]}
"""Types as JSON of those fields whose types in Python are none, or that must not name modules and files of the server."""


def fields_of(settings: type[Any]) -> dict[str, Any]:
    """Type, default and description of a dataclass's fields, as pydantic takes them."""
    hints, told = get_type_hints(settings) | WIRE_TYPES, field_docs(settings)
    types = {name: without_truths(kind) for name, kind in hints.items()}
    return {f.name: (types[f.name], Field(... if f.default is MISSING else f.default, description=told.get(f.name)))
            for f in fields(settings)}


def without_truths(kind: Any) -> Any:
    """A type whose numbers are neither true nor false."""
    if kind in {int, float}:
        return Annotated[kind, BeforeValidator(no_truth)]
    if not (parts := get_args(kind)) or get_origin(kind) is Literal:
        return kind
    within = tuple(without_truths(part) for part in parts)
    return Union[within] if get_origin(kind) in {Union, UnionType} else get_origin(kind)[within]  # noqa: UP007


def field_docs(settings: type[Any]) -> dict[str, str]:
    """The docstring under each field of a dataclass."""
    body = ast.parse(textwrap.dedent(inspect.getsource(settings))).body[0].body  # type: ignore[attr-defined]
    return {field.target.id: " ".join(str(text.value.value).split()) for field, text in pairwise(body)
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)}


GraspCall: Any = create_model(
    "GraspCall", __base__=_Call, __module__=__name__, __doc__="What is asked: hand, object, and what grasps have to respect.",
    **fields_of(GraspRequest), **fields_of(Constraints))


class GenerateCall(GraspCall):
    """What `dro-grasp generate` asks of one object."""

    protocol: str | None = None
    """Protocol of the trials; `none` for no trial, null for what the command does by default."""
    only_successful: bool = False
    """Put successful grasps alone into the grasp file."""
    path: str | None = None
    """Where the object's file lies; the grasp file records it, and the server does not look there."""


def settings_in(call: Any, settings: type[Settings], **loaded: Any) -> Settings:
    """The dataclass of a class whose fields a GraspCall holds, and those that were loaded from what it holds."""
    return settings(**{f.name: getattr(call, f.name) for f in fields(settings)} | loaded)  # type: ignore[arg-type]


class SentGrasp(Message):
    """A grasp: wrist pose, and the joints of its three postures in the order of `joint_names`."""

    wrist_position: Point
    """Position of the hand's root link [m]."""
    wrist_quaternion_wxyz: Row
    """Its orientation."""
    joints: list[float]
    """Joints in the grasp [rad or m]."""
    pregrasp_joints: list[float]
    """Joints before closing, clear of the object [rad or m]."""
    squeeze_joints: list[float]
    """Targets that press on the object [rad or m]."""
    squeeze_torque: list[float] | None = None
    """Efforts of the joints at the squeeze, positive toward larger values [Nm, N where a joint slides]; null if unknown."""
    squeeze_force: float | None = None
    """Sum of the normal forces at the squeeze [N]; null if unknown."""
    payload: float | None = None
    """Largest mass that the grasp carries [kg]; null if unknown."""
    score: float
    """Log-odds of holding; higher is better."""
    origin: str
    """Source that proposed it: `network`, `optimiser`, or `variation` of the best so far."""
    success: bool | None = None
    """Whether it held in its trial; null without one."""
    reason: str | None = None
    """Why it did not, in words."""


class GraspAnswer(Message):
    """Grasps, the best first."""

    id: str
    """Of the request."""
    hand: str
    """Name of the hand."""
    object: str
    """Name of the object."""
    frame: str
    """Frame of the wrist poses: the camera's named frame, or `object`, that of the given mesh or cloud."""
    wrist_link: str
    """The hand's root link, which the wrist poses are of."""
    joint_names: list[str]
    """The independent joints."""
    grasps: list[SentGrasp]
    """The best first."""
    candidates: int
    """How many candidates they were chosen from."""
    weights: str
    """Name of the weights."""
    protocol: str | None
    """Of the trial; null without one."""
    notes: list[str]
    """What was found and repaired in the object, and what is doubtful."""
    shortage: str | None
    """Why there are fewer grasps than were asked for; null if there are as many."""
    seconds: dict[str, float]
    """Time by part [s]."""


class GenerateAnswer(Message):
    """What `dro-grasp generate` tells and saves of one object."""

    report: dict[str, Any]
    """What the command prints with --json, without times and files of its own."""
    rows: list[list[Any]]
    """Rows of the table that it prints."""
    lines: list[str]
    """What it prints under the table."""
    warnings: list[str]
    """What it prints beside these."""
    seconds: dict[str, float]
    """Time by part [s]."""
    file: str
    """The grasp file, in base64."""
    kept: int
    """Number of grasps in it."""


class Refusal(Message):
    """Why there is no answer."""

    error: str
    """What was given, what was expected and what to do."""
