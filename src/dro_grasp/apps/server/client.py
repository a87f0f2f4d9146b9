"""Asking a grasp server from Python, with the standard library, and for points NumPy."""

from __future__ import annotations

import base64
import io
import json
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import ProxyHandler, Request, build_opener

from dro_grasp.apps.origins import LOCAL
from dro_grasp.errors import OptionError, ServerError
from dro_grasp.files import given_path, reason_of
from dro_grasp.kinds import checked

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
else:
    ArrayLike = Any  # without NumPy, which names and files do without


class GraspClient:
    """A grasp server at an address.

    Examples:
        >>> answer = GraspClient().predict("allegro", cloud, num=4, direction=(0, 0, -1))
        >>> answer["grasps"][0]["wrist_position"]
    """

    @checked
    def __init__(self, url: str = "http://127.0.0.1:8090", token: str | None = None, timeout: float = 120.0) -> None:
        """Remember where to ask.

        Args:
            url: Address of the server.
            token: What the server demands, if it has one.
            timeout: Longest wait for an answer [s].

        Raises:
            OptionError: The token cannot be sent.
        """
        if token and not (token.isascii() and token.isprintable()):
            raise OptionError("token holds characters that a header cannot bear; give the server and its clients one of ASCII "
                              "letters, digits and signs")
        self.url, self.timeout = url.rstrip("/"), timeout
        self.headers = {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {token}"} if token else {})

    @checked
    def predict(self, hand: str, obj: str | Path | ArrayLike, num: int = 16, **options: Any) -> dict[str, Any]:
        """The server's answer: its list `grasps`, the best first, and all that is known of it.

        Args:
            hand: Name of a hand that the server knows.
            obj: The path of a mesh or cloud, which is sent; the name of an object that the server knows; or points,
                (n, 3), as an array, tensor or nested lists [m].
            num: Grasps to return.
            options: What else a request holds, such as direction, table, mass, camera, protocol; scale and keep_table are the
                object's, and obstacles is a path or points, as the object is. choose says which thing of a scene is meant: a
                dict of at, pixel, nearest or mask, which is an array or the path of a PNG. Numbers may be arrays or tensors.

        Raises:
            OptionError: A value cannot be sent.
            ServerError: The server refuses, fails or is not there.
        """
        of_object = {name: options.pop(name) for name in ("scale", "keep_table") if name in options}
        if options.get("obstacles") is not None:
            options["obstacles"] = sent_object(options["obstacles"])
        if not isinstance(choose := options.get("choose") or {}, Mapping):
            raise OptionError(f"choose is {choose!r}; give a dict of at, pixel, nearest or mask")
        if choose.get("mask") is not None:
            options["choose"] = {**choose, "mask": sent_mask(choose["mask"])}
        call = {"hand": hand, "object": sent_object(obj) | of_object, "num": num, "id": uuid.uuid4().hex, **options}
        return self.ask("POST", "/grasps", call)

    def cancel(self, name: str) -> None:
        """Cancel the request of this id."""
        self.ask("DELETE", f"/grasps/{name}")

    def ask(self, method: str, page: str, content: dict[str, Any] | None = None) -> Any:
        """What a page of the server answers; where it is busy, it is asked again when it says, until the timeout.

        Raises:
            OptionError: The content cannot be sent.
            ServerError: It refuses, fails or is not there.
        """
        body = None if content is None else json.dumps(content, default=listed).encode()
        end = time.monotonic() + self.timeout
        while True:
            try:
                return self._asked(method, page, body)
            except ServerError as error:
                if error.retry_after is None or time.monotonic() + error.retry_after > end:
                    raise
                time.sleep(error.retry_after)

    def _asked(self, method: str, page: str, body: bytes | None) -> Any:
        try:
            here = urlsplit(self.url).hostname in LOCAL  # no proxy reaches this machine's own addresses
            opener = build_opener(ProxyHandler({})) if here else build_opener()
            with opener.open(Request(self.url + page, body, self.headers, method=method), timeout=self.timeout) as answer:
                return json.load(answer)
        except HTTPError as error:
            again = error.headers.get("Retry-After", "")
            raise ServerError(_reason(error), float(again) if again.isdecimal() else None, error.code) from error
        except TimeoutError as error:
            raise ServerError(f"the grasp server at {self.url} gave no answer in {self.timeout:g} s; ask for fewer grasps, or "
                              "give GraspClient a longer timeout") from error
        except (URLError, OSError, HTTPException, ValueError) as error:  # other programs answer in other ways
            raise ServerError(f"no grasp server answers at {self.url} ({reason_of(error)}); give http://HOST:PORT, or start "
                              "one with `dro-grasp serve`") from error


def _reason(error: HTTPError) -> str:
    """Why the server, or another program at its address, refuses."""
    why = ""
    with error, suppress(OSError, HTTPException, ValueError):  # the connection may end within the answer
        why = error.read().decode(errors="replace")
        told = json.loads(why)
        if isinstance(told, dict) and isinstance(told.get("error"), str):
            return told["error"]
    return f"{error}: {why[:200]}"


def listed(value: Any) -> Any:
    """An array or tensor as lists of numbers, as JSON has them; lists stay."""
    if isinstance(value, list | tuple):
        return value
    if not hasattr(value, "tolist"):
        raise OptionError(f"a {type(value).__name__} cannot be sent to a grasp server; give names and paths as text, and "
                          "numbers as numbers, lists or arrays")
    return value.tolist()


def sent_object(obj: str | Path | ArrayLike) -> dict[str, Any]:
    """An object as a request holds it: its file's bytes, its points as a file, or its name."""
    if isinstance(obj, str | Path):
        path = given_path(obj)
        return sent_file(path.name, path.read_bytes()) if path.is_file() else {"name": str(obj)}
    import numpy as np

    try:
        points = np.asarray(obj if isinstance(obj, np.ndarray) else listed(obj))
    except ValueError:  # rows of several lengths
        points = np.array(None)
    if points.dtype.kind not in "iuf":
        raise OptionError(f"a {type(obj).__name__} that holds no array of numbers cannot be sent as an object; give the name "
                          "of one that the server knows, the path of a mesh or cloud, or points (n, 3)")
    np.save(file := io.BytesIO(), points)
    return sent_file("cloud.npy", file.getvalue())


def sent_mask(mask: str | Path | ArrayLike) -> dict[str, Any]:
    """A mask as a request holds it: a PNG, not black where it is true or not 0."""
    if isinstance(mask, str | Path):
        if not (path := given_path(mask)).is_file():
            raise OptionError(f"mask: no file at {path}; give the path of a PNG, or an array (h, w)")
        return sent_file("mask.png", path.read_bytes())["file"]
    import numpy as np
    from PIL import Image

    Image.fromarray(np.asarray(mask) != 0).save(file := io.BytesIO(), format="PNG")
    return sent_file("mask.png", file.getvalue())["file"]


def sent_file(name: str, content: bytes) -> dict[str, Any]:
    """An object's file as a request holds it."""
    return {"file": {"name": name, "content": base64.b64encode(content).decode()}}
