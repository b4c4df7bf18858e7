"""Driver for sound cards, and for IEPE interfaces that are sound cards; needs the extra ``audio``.

Each sensor has some inputs of the card; one clock samples all inputs. PortAudio hands on the
samples in a thread of its own. If the computer is too slow for it, PortAudio says that samples were
lost, but not how many: the gap follows from the times at which PortAudio says the card sampled, or
from the host's, and is marked as estimated.

Counts are those of the card, with 32 bits (cards of 24 bits fill the upper ones). A channel's
``sensitivity`` is counts per volt times the sensor's volts per unit. Cards have a high-pass filter,
often at some Hz: give it as the channel's ``response``.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from daq.devices.blocking import BlockingSource, Samples
from daq.devices.interface import DeviceInformation, Driver, DriverSettings, PresentPort
from daq.devices.port_rules import inputs_of, package, port_label
from daq.errors import NotConnectedError, WrongDeviceError
from daq.protocols.block import BlockFlag

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock

SCHEME = "audio://"
BLOCK_SECONDS = 0.1
"""Seconds of samples that PortAudio hands on together."""
LATENCY = 0.5
"""Seconds that the card's buffer may hold: no display needs them at once."""
READ_TIMEOUT = 0.5
MAX_PENDING = 64
"""Blocks that wait for the thread of the session."""
FULL_SCALE = 2**31 - 2**8
"""Counts at the end of the range of a card of 24 bits."""


class SoundSettings(DriverSettings):
    """``[sensors.settings]`` of a sensor on a sound card."""

    inputs: tuple[Annotated[int, Field(ge=1, le=128)], ...] | None = None
    """The input of each channel, from 1; default: the inputs after those of the port's previous
    sensors."""


class Capture:
    """What PortAudio hands on, as reads of a blocking library.

    Parameters
    ----------
    clock : HostClock
    rate : float
        In Hz.
    columns : sequence of int
        The card's inputs, from 0, in the order of the channels.
    """

    def __init__(self, clock: HostClock, rate: float, columns: Sequence[int]) -> None:
        self._clock = clock
        self._rate = rate
        self._columns = list(columns)
        self._pending: queue.Queue[Samples] = queue.Queue(MAX_PENDING)
        self._after: tuple[float, float] | None = None  # by the card's time and by the host's, s
        self._missing, self._flags = 0, BlockFlag.NONE

    def received(self, samples: NDArray[np.int32], sampled_at: float, *, overflowed: bool) -> None:
        """Take a block; called by PortAudio in its thread.

        Parameters
        ----------
        samples : int32, shape (n_samples, n_inputs)
        sampled_at : float
            When the card took the first sample, by PortAudio's clock in s; 0 if it does not say.
        overflowed : bool
            Whether samples were lost before these.
        """
        at = self._clock.now()
        n_samples = len(samples)
        host = at.monotonic_ns * 1e-9
        if overflowed and self._after is not None:
            is_known = sampled_at > 0 and self._after[0] > 0
            late = sampled_at - self._after[0] if is_known else host - self._after[1]
            self._missing += max(1, round(late * self._rate))
            self._flags |= BlockFlag.MISSING_ESTIMATED
        length = n_samples / self._rate
        self._after = sampled_at + length if sampled_at > 0 else 0.0, host + length
        counts = samples[:, self._columns].copy()
        flags = self._flags
        if counts.max() >= FULL_SCALE or counts.min() <= -FULL_SCALE:
            flags |= BlockFlag.CLIPPED
        reason = "overflow of the sound card's buffer" if self._missing else ""
        one = Samples(counts, None, self._missing, reason, flags, at)
        try:
            self._pending.put_nowait(one)
        except queue.Full:
            self._missing += n_samples
        else:
            self._missing, self._flags = 0, BlockFlag.NONE

    def read(self) -> Samples | None:
        """Return the next block; None after a while without one."""
        try:
            return self._pending.get(timeout=READ_TIMEOUT)
        except queue.Empty:
            return None


class SoundDriver(Driver[SoundSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "sound"
    summary = "sound cards and IEPE interfaces that are sound cards, several sensors on one"
    settings = SoundSettings
    shares_clock = True

    def full_scale(self, sensor: Sensor) -> float | None:  # noqa: ARG002 -- interface
        """See :meth:`daq.bench.driver_rules.DriverRules.full_scale`."""
        return FULL_SCALE

    def check(self, sensors: Sequence[Sensor]) -> dict[str, tuple[int, ...]]:
        """Return the inputs of each sensor."""
        settings = self.typed(sensors)

        def given(sensor: Sensor, used: Collection[int]) -> Sequence[int]:
            if not sensor.port.startswith(SCHEME):
                expected = (
                    "expected audio:// and a part of the card's name; audio:// is the default"
                )
                raise sensor.fault("port", expected, sensor.port)
            first = max(used, default=0) + 1
            following = range(first, first + len(sensor.channels))
            return settings[sensor.name].inputs or following

        return inputs_of(sensors, given)

    def ports(self) -> list[PresentPort]:
        """See :class:`daq.devices.interface.Listing`."""
        with _portaudio("sound cards") as library:
            found = []
            for card in _cards(library):
                about = f"{card['max_input_channels']} inputs, {card['default_samplerate']:g} Hz"
                found.append(PresentPort(f"{SCHEME}{card['name']}", about))
            return found

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[BlockingSource]:
        """Find the card by its name, and open its inputs."""
        inputs, label = self.check(sensors), port_label(sensors)
        rate, numbers = sensors[0].sampling_rate, [n for some in inputs.values() for n in some]
        capture = Capture(clock, rate, [number - 1 for number in numbers])
        wanted = sensors[0].port.removeprefix(SCHEME)
        with _portaudio(label) as library:
            card = _card(library, wanted, max(numbers), label)

            def received(samples: Any, n: int, times: Any, status: Any) -> None:  # noqa: ANN401
                del n
                sampled_at = float(times.inputBufferAdcTime)
                capture.received(samples, sampled_at, overflowed=bool(status.input_overflow))

            def make() -> Any:  # noqa: ANN401
                return library.InputStream(
                    device=card["index"],
                    channels=max(numbers),
                    samplerate=rate,
                    dtype="int32",
                    blocksize=max(1, round(BLOCK_SECONDS * rate)),
                    latency=LATENCY,
                    callback=received,
                )

            try:
                stream = await asyncio.to_thread(make)
            except library.PortAudioError as error:
                raise NotConnectedError(
                    f"{label}: {card['name']!r} does not sample {max(numbers)} inputs at"
                    f" {rate:g} Hz: {error}"
                ) from error

            def read() -> Samples | None:
                found = capture.read()
                if found is None and not stream.active:
                    raise NotConnectedError(f"{label}: the sound card stopped; check its cable")
                return found

            model, rate, information = card["name"], float(stream.samplerate), []
            for name, some in inputs.items():
                details = {"inputs": ", ".join(map(str, some))}
                one = DeviceInformation(name, model=model, sampling_rate=rate, details=details)
                information.append(one)
            start, stop = stream.start, stream.stop  # to abort would cancel a thread with Python
            try:
                yield BlockingSource(
                    sensors, clock, start=start, read=read, stop=stop, information=information
                )
            finally:
                await asyncio.to_thread(_close, stream)


def _close(stream: Any) -> None:  # noqa: ANN401
    """Close a stream that may still be active: to close such a one can wait for ever."""
    if stream.active:
        stream.stop()
    stream.close()


_lock = threading.Lock()
_n_open = 0


@contextlib.contextmanager
def _portaudio(label: str) -> Any:  # noqa: ANN401
    """Return PortAudio, with the list of the present devices if no other stream is open."""
    global _n_open  # noqa: PLW0603 -- PortAudio has one list for the process
    further = ", and on Linux the package libportaudio2"
    sounddevice = package("sounddevice", "audio", label, further)  # it loads PortAudio
    with _lock:
        if not _n_open:  # PortAudio lists the devices when it is initialised
            sounddevice._terminate()  # noqa: SLF001 -- the library has no other way
            sounddevice._initialize()  # noqa: SLF001
        _n_open += 1
    try:
        yield sounddevice
    finally:
        with _lock:
            _n_open -= 1


def _cards(library: Any) -> list[dict[str, Any]]:  # noqa: ANN401
    """Return the cards with inputs."""
    return [card for card in library.query_devices() if card["max_input_channels"] > 0]


def _card(library: Any, wanted: str, n_inputs: int, label: str) -> dict[str, Any]:  # noqa: ANN401
    """Return the only card with a name; without a name, the system's default."""
    cards = _cards(library)
    names = ", ".join(repr(card["name"]) for card in cards) or "none"
    if not wanted:
        index = library.default.device[0]
        found = [card for card in cards if card["index"] == index]
    else:
        found = [card for card in cards if card["name"] == wanted]
        found = found or [card for card in cards if wanted.lower() in card["name"].lower()]
    if len(found) != 1:
        which = "several have" if found else "none has"
        raise NotConnectedError(f"{label}: {which} {wanted!r} in its name; sound cards: {names}")
    if found[0]["max_input_channels"] < n_inputs:
        raise WrongDeviceError(
            f"{label}: {found[0]['name']!r} has {found[0]['max_input_channels']} inputs; expected"
            f" at least {n_inputs}"
        )
    return found[0]


DRIVER = SoundDriver()
