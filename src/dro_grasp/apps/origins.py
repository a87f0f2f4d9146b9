"""Who may talk to what is served: those who know this machine's address or name, and browsers that show this very page.

Any page in a browser may send requests to a server on the same machine, or give a name of its own to that machine's address.
"""

from __future__ import annotations

import hashlib
import ipaddress
import secrets
import socket
from collections.abc import Collection, Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, unquote, urlsplit

LOCAL = frozenset({"127.0.0.1", "localhost", "::1"})  # Addresses at which only this machine can connect


def own_names(served_at: str) -> frozenset[str]:
    """Names of this machine, and that which it is served at, in small letters.

    A name server may be asked, which takes seconds where none answers: call it once, before requests come.
    """
    return frozenset(name.lower() for name in ("localhost", served_at, socket.gethostname(), socket.getfqdn()))


def refusal(headers: Mapping[str, str], own: Collection[str]) -> str:
    """Why a request with these headers is refused on a machine with these names; empty if it is not."""
    host, origin = headers.get("Host", ""), headers.get("Origin")
    try:
        name = urlsplit(f"//{host}").hostname or ""
        theirs = None if origin is None else urlsplit(origin).netloc
    except ValueError:
        return "its Host or Origin is no address"
    if not (_is_address(name) or name in own):
        return f"it asks for the host '{name}', which is no name of this machine; open the page at the machine's address"
    if theirs is not None and theirs != host:
        return f"it comes from a page of '{origin}', not from this one"
    return ""


def same_token(given: str, token: str) -> bool:
    """Whether a token is the right one; how long it takes tells nothing of it."""
    return secrets.compare_digest(given.encode(), token.encode())


def cookie_of(token: str) -> str:
    """Name of the cookie in which a browser keeps the token of a page; pages on several ports share cookies, but not names."""
    return f"dro-grasp-{hashlib.sha256(token.encode()).hexdigest()[:8]}"


def token_in_address(path: str) -> str:
    """The token that the address of a page states."""
    return parse_qs(urlsplit(path).query).get("token", [""])[0]


def token_in_cookie(cookies: str, token: str) -> str:
    """What a browser kept as the token of this page."""
    try:
        kept = SimpleCookie(cookies).get(cookie_of(token))
    except CookieError:
        return ""
    return "" if kept is None else unquote(kept.value)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
