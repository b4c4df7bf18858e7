"""Who may look at the pages, and who may steer.

Theory of operation
-------------------
Looking and steering are two rights, each with a secret in the bench file: a hash of a password or
of a token, or the variable of the environment that holds a token. Who gives a secret gets a cookie
with name, right and end, authenticated by a key that only the server has. The key is a file beside
the recordings, so that a restart ends no visit; the secret is part of what is authenticated, so
that a new secret ends all. Programs send a token as ``Authorization: Bearer``.

Each wrong secret counts against the network that it came from. Forms that change anything carry a
token made from the cookie, which pages of other sites cannot read.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import ipaddress
import json
import os
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.whole_file import PRIVATE, write_whole
from tui.service.records.places import file_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.bench.tables.unattended import Web

LASTS = 12 * 3600.0
"""Seconds for which a cookie is good."""
ATTEMPTS, WITHIN = 5, 60.0
"""Wrong secrets from one network within so many seconds, after which no more are looked at."""
NETWORKS = 10_000
"""Networks whose attempts are remembered, at most."""
SHORTEST_TOKEN = 16
SHORTEST_PASSWORD = 10
_SCRYPT = {"n": 2**15, "r": 8, "p": 1, "maxmem": 2**26}
_LONGEST = 1024
"""Characters of a secret that are looked at."""


class AccessError(HuddleError):
    """The secrets of the bench file cannot be used."""

    is_usage_error = True


class Right(StrEnum):
    """What a visitor may do; who may steer may also look."""

    READ = "read"
    STEER = "steer"


@dataclass(frozen=True, slots=True)
class Visitor:
    """Who looks at the pages.

    Attributes
    ----------
    name : str
        As given at the login; empty for somebody on this computer who has not logged in.
    right : Right
    form_token : str
        That forms of this visitor carry; empty without a login.
    """

    name: str
    right: Right
    form_token: str = ""

    @property
    def may_steer(self) -> bool:
        """Whether the visitor may start, stop and mark."""
        return self.right is Right.STEER


class TooManyAttemptsError(HuddleError):
    """Too many wrong secrets came from this network; the message has the seconds to wait."""

    def __init__(self, seconds: float) -> None:
        self.seconds = max(1, round(seconds))
        super().__init__(f"too many wrong passwords; try again in {self.seconds} s")


def password_hash(password: str) -> str:
    """Return the line of a bench file for a password."""
    salt = secrets.token_bytes(16)
    return f"scrypt:{salt.hex()}:{_scrypt(password, salt).hex()}"


def token_hash(token: str) -> str:
    """Return the line of a bench file for a token, which is long and random."""
    return f"sha256:{hashlib.sha256(token.encode()).hexdigest()}"


def _scrypt(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, dklen=32, **_SCRYPT)


def _fits(secret: str, given: str) -> bool:
    """Return whether a password or token is that of a hash; takes as long for a wrong one."""
    kind, *parts = secret.split(":")
    if kind == "sha256":
        return hmac.compare_digest(secret, token_hash(given))
    salt, wanted = (bytes.fromhex(part) for part in parts)
    return hmac.compare_digest(_scrypt(given, salt), wanted)


def _resolved(secret: str | None, environment: Mapping[str, str]) -> str | None:
    if secret is None or not secret.startswith("${"):
        return secret
    token = environment.get(secret[2:-1], "")
    if len(token) < SHORTEST_TOKEN:
        raise AccessError(
            f"web: the variable {secret} of the environment has {len(token)} characters; expected a"
            f" token of at least {SHORTEST_TOKEN}"
        )
    return token_hash(token)


_KEY_BYTES = 32


def server_key(bench: Bench) -> bytes:
    """Return the key of the server of a bench; make it the first time.

    Raises
    ------
    OSError
        If the folder of the recordings cannot be written.
    """
    path: Path = bench.recording_directory / f".{file_name(bench.name)}.web-key"
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_file() and path.stat().st_size < _KEY_BYTES:
        path.unlink()  # of an earlier version that was killed while it wrote
    with contextlib.suppress(FileExistsError):  # another process makes it, too
        if not path.is_file():
            write_whole(path, secrets.token_bytes(_KEY_BYTES), mode=PRIVATE, free=True)
    return path.read_bytes()


class _Attempts:
    """Wrong secrets by network, the newest last."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._times: OrderedDict[str, list[float]] = OrderedDict()

    def begin(self, client: str) -> str:
        """Count an attempt from an address as wrong for now; return its network.

        Raises
        ------
        TooManyAttemptsError
            If there were too many; this one must not be looked at.
        """
        network, now = _network(client), self._now()
        times = [each for each in self._times.get(network, ()) if now - each < WITHIN]
        if len(times) >= ATTEMPTS:
            raise TooManyAttemptsError(times[0] + WITHIN - now)
        self._times[network] = [*times, now]
        self._times.move_to_end(network)
        while len(self._times) > NETWORKS:
            self._times.popitem(last=False)
        return network

    def was_right(self, network: str) -> None:
        """Take back what `begin` has counted."""
        if self._times.get(network):
            self._times[network].pop()


def _network(client: str) -> str:
    """Return what one person has of addresses: one of version 4, 2⁶⁴ of version 6."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        return client
    if address.version == 4:
        return str(address)
    return str(ipaddress.ip_network((int(address) >> 64 << 64, 64)))


class Access:
    """Rights of visitors of one server.

    Parameters
    ----------
    web : Web
        The table of the bench file.
    key : bytes
        Known to the server alone.
    environment : mapping, optional
        Of the process, if not given.
    now : callable
        UTC in s since 1970.

    Raises
    ------
    AccessError
        If a variable of the environment has no token.
    """

    def __init__(
        self,
        web: Web,
        key: bytes,
        *,
        environment: Mapping[str, str] | None = None,
        now: Callable[[], float] = time.time,
    ) -> None:
        environment = os.environ if environment is None else environment
        found = {Right.STEER: web.steer, Right.READ: web.read}
        self._secrets = {
            right: secret
            for right, line in found.items()
            if (secret := _resolved(line, environment)) is not None
        }
        self._key, self._now = key, now
        self._attempts = _Attempts(now)

    @property
    def is_open(self) -> bool:
        """Whether anybody who reaches the server may look."""
        return Right.READ not in self._secrets

    @property
    def has_secrets(self) -> bool:
        """Whether there is anything to log in for."""
        return bool(self._secrets)

    def log_in(self, client: str, name: str, given: str) -> str | None:
        """Return a cookie for who gives a secret; None for a wrong one. Takes a tenth of a second.

        Raises
        ------
        TooManyAttemptsError
            If too many wrong ones came from the network of this client.
        """
        right = self._right_of(client, given, self._secrets)
        if right is None:
            return None
        told = {"name": name, "right": right, "ends": self._now() + LASTS}
        about = base64.urlsafe_b64encode(json.dumps(told).encode()).decode()
        return f"{about}.{self._mac(right, about)}"

    def by_cookie(self, cookie: str) -> Visitor | None:
        """Return who has a cookie; None if it is not of this server, or has ended."""
        about, _, mac = cookie.partition(".")
        try:
            told = json.loads(base64.urlsafe_b64decode(about))
            right, ends, name = Right(told["right"]), float(told["ends"]), str(told["name"])
        except (ValueError, KeyError, TypeError, RecursionError):
            return None
        if right not in self._secrets or not hmac.compare_digest(mac, self._mac(right, about)):
            return None
        if ends < self._now():
            return None
        return Visitor(name, right, self._mac(right, "form", cookie))

    def by_token(self, client: str, token: str) -> Visitor | None:
        """Return the program that sends a token; passwords are for people.

        Raises
        ------
        TooManyAttemptsError
            If too many wrong ones came from the network of this client.
        """
        tokens = {r: s for r, s in self._secrets.items() if s.startswith("sha256:")}
        right = self._right_of(client, token, tokens)
        return None if right is None else Visitor("token", right)

    @property
    def anybody(self) -> Visitor | None:
        """Who has not logged in; None where that is needed to look."""
        return Visitor("", Right.READ) if self.is_open else None

    def _right_of(self, client: str, given: str, known: Mapping[Right, str]) -> Right | None:
        network = self._attempts.begin(client)
        if len(given) > _LONGEST:
            return None
        for right, secret in known.items():
            if _fits(secret, given):
                self._attempts.was_right(network)
                return right
        return None

    def _mac(self, right: Right, *parts: str) -> str:
        message = "\0".join((right, self._secrets[right], *parts))
        return hmac.new(self._key, message.encode(), "sha256").hexdigest()
