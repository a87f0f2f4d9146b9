"""Damage to files: single bytes, tokens of text, XML elements and attributes, values of JSON, arrays of tensors and tables.

Each function takes a source of random numbers and a sound input, and returns a damaged one.
"""

from __future__ import annotations

import copy
import random
import re
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pyarrow as pa
import torch

NUMBERS = (
    "nan", "inf", "-inf", "1e300", "-1e300", "1e30", "1e6", "1e-300", "1e-9", "0", "-0", "-1", "1", "2147483648", "9" * 30,
    "0x10", "", "a", "true", "1 2 3 4 5 6 7", "0 0 0", "nan nan nan", "1e30 1e30 1e30", "1e-30 1e-30 1e-30", "1,5", "\u0661",
)
"""Tokens that take the place of numbers (ours)."""
NAMES = (
    "world", "palm", "left", "a", "", "a" * 10_000, "../../../etc/passwd", "/dev/zero", "~nobody/x", "package://x/y.stl",
    "file:///etc/hostname", "hand.xml", "hand.urdf", ".", "\u202ex", "left.obj",
)
"""Tokens that take the place of names and paths (ours)."""
VALUES: tuple[Any, ...] = (
    None, [], {}, "", "x", 0, -1, 1, 1.5, 10_000, 1e308, float("nan"), float("inf"), True, False, [None], ["x"], [[]],
    [1, 2, 3], 10**30, {"x": {}}, "a" * 10_000, "~nobody/x", "../..", 2**63,
)
"""Values that take the place of JSON values (ours)."""
ELEMENTS = (
    '<replicate count="1000000" euler="0 0 1"><body name="r"><geom size="0.01"/></body></replicate>',
    '<replicate count="-1"><body><geom size="0.01"/></body></replicate>',
    '<hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/>',
    '<texture name="t" type="2d" builtin="flat" width="60000" height="60000"/>',
    '<include file="hand.xml"/>', '<include file="/etc/hostname"/>', '<attach model="m" body="palm" prefix="x"/>',
    '<model name="m" file="hand.xml"/>', '<body name="b"><attach model="m" body="palm" prefix="y"/></body>',
    '<composite type="cable" prefix="c" count="100000 1 1" size="1"><joint kind="main"/><geom size="0.01"/></composite>',
    '<flexcomp type="grid" count="500 500 500" spacing="1 1 1" name="f" dim="3"/>',
    '<plugin plugin="mujoco.elasticity.cable"/>',
    '<joint type="ball"/>', '<freejoint/>', '<mesh name="q" file="/dev/zero"/>',
    '<mesh name="q" vertex="0 0 0 1 0 0 0 1 0"/>',
    '<mesh name="q" builtin="supersphere" params="10000 1 1"/>',
    '<joint name="zz" axis="0 0 0"/>', '<geom type="mesh" mesh="q"/>',
    '<geom type="plane" size="0 0 1"/>', '<geom type="sdf" mesh="q"/>', '<skin name="s"/>', '<site name="s"/>',
    '<equality><joint joint1="a" polycoef="0 0 0 0 0"/></equality>', '<equality><weld body1="palm"/></equality>',
    '<default class="x"><joint range="nan nan"/></default>', '<option timestep="nan"/>', '<size memory="100G"/>',
    '<keyframe><key name="open" qpos="nan"/></keyframe>', '<compiler angle="degree" meshdir="/"/>', '<mimic joint="a"/>',
    '<mimic joint="b" multiplier="1e30" offset="nan"/>', '<limit lower="-1e6" upper="1e6" effort="1" velocity="1"/>',
    '<mesh filename="left.obj" scale="1e30 1 1"/>', '<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro"/>', "<x/>",
    '<inertial><mass value="-1"/></inertial>', '<inertial pos="0 0 0" mass="1" diaginertia="1 -1 9"/>',
    '<inertial pos="0 0 0" mass="1" fullinertia="1 1 1 9 9 9"/>', '<connect site1="s" site2="s"/>',
    '<equality><connect body1="left" body2="right" anchor="0 0 0"/></equality>',
    '<tendon><spatial name="sp"><site site="s"/><pulley divisor="2"/><site site="s"/></spatial></tendon>',
    '<inertial><mass value="inf"/><inertia ixx="nan" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>',
)
"""Elements that are put anywhere into a description (ours): what is endless, huge, refers to itself, or is out of place."""

NESTED = "nested"
"""Tag of an element in whose place others are nested deeply (ours)."""
LONGEST_TEXT = 10**8
"""Most characters that the repetitions of a line may have (ours); readers refuse files of twice that."""


def damage_bytes(rng: random.Random, data: bytes) -> bytes:
    """One to four changes of bytes anywhere."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        n = len(data)
        at, end = rng.randrange(n + 1), 0
        end = min(n, at + rng.choice((1, 2, 4, 8, 64, 1000)))
        kind = rng.randrange(7)
        if kind == 0:
            data = data[:at]
        elif kind == 1:
            data = data[:at] + data[end:]
        elif kind == 2:
            data = data[:at] + rng.randbytes(end - at) + data[end:]
        elif kind == 3:
            data = data[:at] + rng.choice((b"\xff", b"\x00", b"\x7f")) * (end - at) + data[end:]
        elif kind == 4:
            data = data[:end] + data[at:end] * rng.choice((1, 3, 50)) + data[end:]
        elif kind == 5 and n:
            at = min(at, n - 1)
            data = data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
        else:
            at = rng.randrange(min(n, 100) + 1)  # headers are at the beginning
            data = data[:at] + rng.randbytes(4) + data[at + 4 :]
    return data


def damage_text(rng: random.Random, text: str) -> str:
    """Other numbers and names in a text, lines lost and repeated."""
    for _ in range(rng.choice((1, 1, 2, 5))):
        spans = [m.span() for m in re.finditer(r"[^\s,:{}\[\]]+", text[:10**5])]
        lines = text.splitlines(keepends=True)
        kind = rng.randrange(6)
        if kind < 4 and spans:
            start, end = rng.choice(spans)
            text = text[:start] + rng.choice(NUMBERS + NAMES) + text[end:]
        elif lines and len(text) < 10**6:
            i = rng.randrange(len(lines))
            lines[i : i + 1] = [] if kind == 4 else [lines[i]] * min(rng.choice((2, 20, 1000)), LONGEST_TEXT // len(lines[i]))
            text = "".join(lines)
    return text


def damage_xml(rng: random.Random, text: str) -> str:
    """Other attributes, elements lost, repeated, moved, nested and out of place; the result is XML."""
    root = ET.fromstring(text)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 5))):
        every = list(root.iter())
        element, other = rng.choice(every), rng.choice(every)
        kind = rng.randrange(20)
        if kind < 9 and element.attrib:
            name = rng.choice(list(element.attrib))
            element.set(name, _other_value(rng, element.get(name, "")))
        elif kind == 9:
            element.attrib.pop(rng.choice(list(element.attrib) or [""]), None)
        elif kind == 10:
            element.attrib.update(other.attrib)
        elif kind in (11, 12) and len(element):
            element.remove(rng.choice(list(element)))
        elif kind == 13 and len(element):
            child = rng.choice(list(element))
            element.extend([copy.deepcopy(child) for _ in range(rng.choice((1, 2, 40)))])
        elif kind == 14:
            other.append(copy.deepcopy(element))
        elif kind == 15:
            element.tag = other.tag
        elif kind == 16:
            element.append(ET.Element(NESTED))
        elif kind == 17:
            element.text = rng.choice(NUMBERS + NAMES)
        else:
            element.append(ET.fromstring(rng.choice(ELEMENTS)))
    depth, tag = rng.choice((20, 300, 3000)), rng.choice((root.tag, "body", "link"))
    return ET.tostring(root, encoding="unicode").replace(f"<{NESTED} />", f"<{tag}>" * depth + f"</{tag}>" * depth)


def _other_value(rng: random.Random, value: str) -> str:
    words = value.split()
    if not words or rng.random() < 0.3:
        return rng.choice(NUMBERS + NAMES)
    i = rng.randrange(len(words))
    try:
        float(words[i])
        words[i] = rng.choice(NUMBERS)
    except ValueError:
        words[i] = rng.choice(NAMES)
    return " ".join(words)


def damage_json(rng: random.Random, value: Any) -> Any:
    """A JSON value with one to three values replaced, lost or added, at any depth."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        value = _damaged_value(rng, value)
    return value


def _damaged_value(rng: random.Random, value: Any) -> Any:
    if isinstance(value, dict) and value and rng.random() < 0.85:
        name, kind = rng.choice(list(value)), rng.randrange(8)
        if kind == 0:
            return {k: v for k, v in value.items() if k != name}
        if kind == 1:
            return value | {rng.choice(("x", "", "format_version")): rng.choice(VALUES)}
        return value | {name: _damaged_value(rng, value[name])}
    if isinstance(value, list) and value and rng.random() < 0.7:
        i, kind = rng.randrange(len(value)), rng.randrange(5)
        changed = [] if kind == 0 else [value[i]] * 2 if kind == 1 else [_damaged_value(rng, value[i])]
        return value[:i] + changed + value[i + 1 :]
    return rng.choice(VALUES)


def damage_tensors(rng: random.Random, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Tensors with one or two of another value, type or shape, or lost."""
    tensors = dict(tensors)
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(list(tensors))
        value, kind = tensors[name].clone(), rng.randrange(9)
        if kind < 3 and value.is_floating_point():
            value.view(-1)[rng.randrange(max(1, value.numel())) :][:1] = rng.choice((torch.nan, torch.inf, -torch.inf, -1.0))
        elif kind == 3 and value.is_floating_point():
            value = torch.full_like(value, rng.choice((torch.nan, 0.0, 1.0)))
        elif kind == 4:
            value = value[..., None] if rng.random() < 0.5 else value.reshape(-1)
        elif kind == 5:
            value = value.to(rng.choice((torch.int8, torch.bool, torch.int64, torch.float64, torch.complex64)))
        elif kind == 6:
            value = value.reshape(-1)[: value.numel() // 2]
        elif kind == 7 and not value.is_floating_point():
            value = torch.full_like(value, rng.choice((-1, 100)))
        elif kind == 8:
            del tensors[name]
            if not tensors:
                return {"x": value}
            continue
        tensors[name] = value.contiguous()
    return tensors


def damage_columns(rng: random.Random, columns: dict[str, pa.Array]) -> dict[str, pa.Array]:
    """A table's columns with one or two lost, renamed, or of another type."""
    columns = dict(columns)
    n = len(next(iter(columns.values())))
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(list(columns))
        kind = rng.randrange(14)
        others = (  # of every type
            pa.nulls(n), pa.array([1] * n), pa.array(["x"] * n), pa.array([True] * n), pa.array([1.5] * n),
            pa.array([[1.0]] * n), pa.array([["x"]] * n), pa.array([{"x": 1}] * n), pa.array([b"x"] * n),
            pa.array([float("nan")] * n),
            pa.array([[float("inf")] * 3] * n), pa.array([[None, 1.0, 2.0]] * n),
        )
        if kind < len(others):
            columns[name] = others[kind]
        elif kind == 12 and len(columns) > 1:
            columns["x"] = columns.pop(name)
        else:
            columns = {key: value.slice(0, 0) for key, value in columns.items()}
            n = 0
    return columns


def damage_npy(rng: random.Random, array: np.ndarray) -> bytes:
    """An NPY file whose header lies."""
    shape = rng.choice((array.shape, (10**10, 3), (-1, 3), (3,), (), (2**62, 3), (0, 3), array.shape[::-1]))
    kind = rng.choice(("<f8", "<f4", "|O", "<i4", "|b1", "<U5", "<c16", "|V8", "<f8'}", "x", "<M8[s]", ">f2"))
    header = f"{{'descr': '{kind}', 'fortran_order': {rng.choice((True, False))}, 'shape': {shape}, }}"
    if rng.random() < 0.4:
        header = damage_text(rng, header)
    text = header.encode("latin1", "replace")[:60_000] + b"\n"
    return b"\x93NUMPY" + bytes([rng.choice((1, 1, 2, 3, 9)), 0]) + len(text).to_bytes(2, "little") + text + array.tobytes()


def odd_mesh(rng: random.Random) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces that are flat, on a line, degenerate, a soup, far away, doubled, or with values that are none."""
    draw = np.random.default_rng(rng.getrandbits(32))
    n = rng.choice((1, 4, 30, 300))
    vertices, faces = draw.uniform(-0.05, 0.05, (n, 3)), draw.integers(0, n, (2 * n, 3))
    kind = rng.randrange(9)
    if kind == 0:
        vertices[:, rng.randrange(3)] = 0
    elif kind == 1:
        vertices = draw.uniform(-0.05, 0.05, (n, 1)) * np.ones(3)
    elif kind == 2:
        faces[:, 1] = faces[:, 0]
    elif kind == 3:
        vertices += rng.choice((1e3, 1e6, 1e9))
    elif kind == 4:
        vertices[rng.randrange(n)] = float(rng.choice(("nan", "inf", "1e30", "0.5")))
    elif kind == 5:
        faces = np.concatenate([faces, faces[:, ::-1]])
    elif kind == 6:
        vertices, faces = draw.uniform(-0.05, 0.05, (6 * n, 3)), np.arange(6 * n).reshape(-1, 3)
    elif kind == 7:
        faces = np.zeros((n, 3), int)
    return vertices, faces
