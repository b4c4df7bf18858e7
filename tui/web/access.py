"""Who may look at the pages, and who may steer.

Theory of operation
-------------------
Looking and steering are two rights, each with a secret in the bench file: a hash of a password or
of a token, or the variable of the environment that holds a token. Who gives a secret gets a cookie
with number, name, right and end, authenticated by a key that only the server has. The key is a file
in the state directory of the user, never among recordings, which others may write or copy. So a
restart ends no visit; the secret is part of what is authenticated, so that a new secret ends all;
and the numbers of visits that were ended by a log out are kept in a file until their cookies end.
Programs send a token as ``Authorization: Bearer``.

Each wrong password counts against the name it was given for and the network it came from, and
against the network alone, because names are free. Tokens are long and random: wrong ones are
counted apart, and a right one is accepted whatever others send from the same network. Forms that
change anything carry a token made from the cookie, which pages of other sites cannot read.
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
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from daq.bench.model import Bench
from daq.bench.tables.unattended import Web
from daq.errors import HuddleError
from daq.whole_file import PRIVATE, write_whole
from tui.service.records.places import file_name

LASTS = 12 * 3600.0
"""Seconds for which a cookie is good."""
ATTEMPTS, OF_NETWORK, WITHIN = 5, 30, 60.0
"""Wrong secrets for one name, and of one network, within so many seconds; then none is read."""
NETWORKS = 10_000
"""Names and networks whose attempts are remembered, at most."""
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
    number : str
        Of the visit; empty without a login.
    ends : float
        UTC in s since 1970, of the visit.
    """

    name: str
    right: Right
    form_token: str = ""
    number: str = ""
    ends: float = 0.0

    @property
    def may_steer(self) -> bool:
        """Whether the visitor may start, stop and mark."""
        return self.right is Right.STEER


class TooManyAttemptsError(HuddleError):
    """Too many wrong secrets came; the message has the seconds to wait."""

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


def _resolved(secret: str | None) -> str | None:
    if secret is None or not secret.startswith("${"):
        return secret
    token = os.environ.get(secret[2:-1], "")
    if len(token) < SHORTEST_TOKEN:
        raise AccessError(
            f"web: the variable {secret} of the environment has {len(token)} characters; expected a"
            f" token of at least {SHORTEST_TOKEN}"
        )
    return token_hash(token)


_KEY_BYTES = 32


def state_folder() -> Path:
    """Return the folder of what servers remember: that of the service, or of the user."""
    given = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if given:
        return Path(given) / ".web"
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(home) / "huddle" / "web"


def state_path(bench: Bench, suffix: str) -> Path:
    """Return a file of the server of a bench; benches differ by name and folder of recordings."""
    folder = str(bench.recording_directory.resolve())
    own = hashlib.sha256(folder.encode()).hexdigest()[:16]
    return state_folder() / f"{file_name(bench.name)}-{own}.{suffix}"


def server_key(path: Path) -> bytes:
    """Return the key of a server; make it the first time.

    Raises
    ------
    AccessError
        If others may read it.
    OSError
        If it cannot be read or written.
    """
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    if not path.is_file():
        with contextlib.suppress(FileExistsError):  # another process makes it, too
            write_whole(path, secrets.token_bytes(_KEY_BYTES), mode=PRIVATE, free=True)
    check_private(path, 0o077)
    return path.read_bytes()


def check_private(path: Path, others: int) -> None:
    """Refuse a key that others may read.

    Parameters
    ----------
    path : Path
    others : int
        The bits of its mode that must be 0.

    Raises
    ------
    AccessError
    """
    if os.name == "posix" and (mode := path.stat().st_mode & others):
        raise AccessError(f"{path}: others may read it (mode {mode:04o}); expected chmod 600")


class Ended:
    """Visits that were ended by a log out, kept until their cookies end.

    Parameters
    ----------
    path : Path
        A line of JSON for each: its number and the end of its cookie.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ends: dict[str, float] = {}
        with contextlib.suppress(FileNotFoundError):
            for line in path.read_text(encoding="utf-8").splitlines():
                with contextlib.suppress(ValueError, TypeError):  # cut off by a kill
                    number, ends = json.loads(line)
                    self._ends[str(number)] = float(ends)

    def __contains__(self, number: str) -> bool:
        return number in self._ends

    def add(self, number: str, ends: float) -> None:
        """End a visit.

        Raises
        ------
        OSError
            If that cannot be written: it is ended until the next start only.
        """
        now = time.time()
        self._ends = {each: end for each, end in self._ends.items() if end >= now}
        self._ends[number] = ends
        lines = (json.dumps(each) for each in self._ends.items())
        write_whole(self._path, "".join(f"{line}\n" for line in lines).encode(), mode=PRIVATE)


class _Attempts:
    """Wrong secrets by what they count against, the newest last."""

    def __init__(self) -> None:
        self._times: OrderedDict[tuple[str, ...], list[float]] = OrderedDict()

    def begin(self, limits: Mapping[tuple[str, ...], int]) -> None:
        """Count an attempt as wrong for now, against each of these.

        Raises
        ------
        TooManyAttemptsError
            If there were too many; this one must not be looked at.
        """
        now, found = time.time(), {}
        for key, most in limits.items():
            found[key] = [each for each in self._times.get(key, ()) if now - each < WITHIN]
            if len(found[key]) >= most:
                raise TooManyAttemptsError(found[key][0] + WITHIN - now)
        for key, times in found.items():
            self._times[key] = [*times, now]
            self._times.move_to_end(key)
        while len(self._times) > NETWORKS:
            self._times.popitem(last=False)

    def was_right(self, limits: Mapping[tuple[str, ...], int]) -> None:
        """Take back what `begin` has counted."""
        for key in limits:
            if self._times.get(key):
                self._times[key].pop()


def network_of(client: str) -> str:
    """Return what one person has of addresses: one of version 4, 2⁶⁴ of version 6."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        return client
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
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
    ended : Ended
        Visits that are over.

    Raises
    ------
    AccessError
        If a variable of the environment has no token.
    """

    def __init__(self, web: Web, key: bytes, ended: Ended) -> None:
        found = {Right.STEER: web.steer, Right.READ: web.read}
        self._secrets = {
            right: secret
            for right, line in found.items()
            if (secret := _resolved(line)) is not None
        }
        self._key, self._ended = key, ended
        self._attempts = _Attempts()

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
            If too many wrong ones came for this name, or from the network of this client.
        """
        network = network_of(client)
        limits = {("password", network): OF_NETWORK, ("password", network, name): ATTEMPTS}
        self._attempts.begin(limits)
        right = _right_of(given, self._secrets)
        if right is None:
            return None
        self._attempts.was_right(limits)
        told = {
            "number": secrets.token_hex(16),
            "name": name,
            "right": right,
            "ends": time.time() + LASTS,
        }
        about = base64.urlsafe_b64encode(json.dumps(told).encode()).decode()
        return f"{about}.{self._mac(right, about)}"

    def by_cookie(self, cookie: str) -> Visitor | None:
        """Return who has a cookie; None if it is not of this server, or has ended."""
        about, _, mac = cookie.partition(".")
        try:
            told = json.loads(base64.urlsafe_b64decode(about))
            right, ends = Right(told["right"]), float(told["ends"])
            name, number = str(told["name"]), str(told["number"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return None
        if right not in self._secrets or not same(mac, self._mac(right, about)):
            return None
        if ends < time.time() or number in self._ended:
            return None
        return Visitor(name, right, self._mac(right, "form", cookie), number, ends)

    def log_out(self, visitor: Visitor) -> None:
        """End a visit.

        Raises
        ------
        OSError
            If it ends until the next start of the server only.
        """
        self._ended.add(visitor.number, visitor.ends)

    def by_token(self, client: str, token: str) -> Visitor | None:
        """Return the program that sends a token; passwords are for people.

        Raises
        ------
        TooManyAttemptsError
            If it is wrong, and too many wrong ones came from the network of this client.
        """
        tokens = {r: s for r, s in self._secrets.items() if s.startswith("sha256:")}
        right = _right_of(token, tokens)
        if right is None:
            self._attempts.begin({("token", network_of(client)): OF_NETWORK})
            return None
        return Visitor("token", right)

    @property
    def anybody(self) -> Visitor | None:
        """Who has not logged in; None where that is needed to look."""
        return Visitor("", Right.READ) if self.is_open else None

    def _mac(self, right: Right, *parts: str) -> str:
        message = "\0".join((right, self._secrets[right], *parts))
        return hmac.new(self._key, message.encode(), "sha256").hexdigest()


def _right_of(given: str, known: Mapping[Right, str]) -> Right | None:
    if len(given) > _LONGEST:
        return None
    return next((right for right, secret in known.items() if _fits(secret, given)), None)


def same(given: str, wanted: str) -> bool:
    """Compare in constant time; of two texts, only those in ASCII can be compared."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), wanted.encode())
