"""Driver for analog inputs of National Instruments (NI-DAQmx); needs the extra ``ni``.

All sensors of a port are one task: one sample clock takes all channels, also those of several
modules of a chassis. NI-DAQmx acquires into a buffer of ``BUFFER_SECONDS``, counts the samples, and
overwrites those that were not read in time. Each read asks for the number of its first sample: the
gap after an overrun has its exact length, and the acquisition goes on.

Counts are volts with NI's calibration, as 64-bit floats; a channel's ``sensitivity`` is volts per
unit. NI-DAQmx itself is National Instruments' installer, and only for Windows and Linux.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat, Strict

from daq.devices.blocking import BlockingSource, Samples
from daq.devices.interface import DeviceInformation, Driver, DriverSettings, PresentPort
from daq.devices.port_rules import inputs_of, package, port_label
from daq.errors import NotConnectedError
from daq.protocols.block import BlockFlag

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Iterator, Sequence

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock

SCHEME = "ni://"
BLOCK_SECONDS = 0.1
"""Seconds of samples of one read."""
BUFFER_SECONDS = 10.0
"""Seconds of samples that NI-DAQmx keeps for a computer that is busy."""
READ_TIMEOUT = 0.5
END_OF_RANGE = 1 - 2.0**-12
"""Share of the range beyond which a sample counts as clipped: NI's calibration moves its ends."""
TERMINALS = {
    "default": "DEFAULT",
    "differential": "DIFF",
    "pseudodifferential": "PSEUDO_DIFF",
    "rse": "RSE",
    "nrse": "NRSE",
}


class NiSettings(DriverSettings, strict=True):
    """``[sensors.settings]`` of a sensor on analog inputs of National Instruments."""

    inputs: Annotated[tuple[str, ...], Strict(strict=False)] | None = None
    """Input of each channel: ``["ai0", "ai1"]`` of a device, ``["Mod1/ai0", "Mod2/ai3"]`` of a
    chassis. Default: ``ai0``, ``ai1``, … after those of the port's previous sensors."""
    range: PositiveFloat = 5.0
    """Volts at the end of the range; the device uses its next larger range."""
    terminal: Literal["default", "differential", "pseudodifferential", "rse", "nrse"] = "default"
    """How the inputs are wired."""
    coupling: Literal["ac", "dc"] | None = None
    """Coupling of the inputs; default: that of the device."""
    excitation: Annotated[float, Field(gt=0, le=0.02)] | None = None
    """Current for IEPE sensors, in A, such as 0.002; default: none."""


@dataclass(frozen=True, slots=True)
class _Inputs:
    """The physical inputs of a sensor and their settings."""

    names: tuple[str, ...]
    settings: NiSettings

    @property
    def device(self) -> str:
        """Name of the device or module of the first input."""
        return self.names[0].partition("/")[0]


class Acquisition:
    """Reads a running task.

    Parameters
    ----------
    task : nidaqmx.Task
        With its channels and its clock.
    ends : sequence of float
        End of the range of each channel, in V.
    """

    def __init__(self, task: Any, ends: Sequence[float]) -> None:  # noqa: ANN401
        from nidaqmx.stream_readers import AnalogMultiChannelReader  # noqa: PLC0415 -- an extra

        self._stream = task.in_stream
        self._reader = AnalogMultiChannelReader(task.in_stream)
        self._rate = float(task.timing.samp_clk_rate)
        self._ends = END_OF_RANGE * np.array(ends)[:, None]
        self._is_behind = False

    def read(self) -> Samples | None:
        """Return the next block; None after a while without one.

        Raises
        ------
        nidaqmx.DaqError
            If the device was disconnected or stopped.
        """
        from nidaqmx.error_codes import DAQmxErrors  # noqa: PLC0415 -- an extra
        from nidaqmx.errors import DaqReadError  # noqa: PLC0415 -- an extra

        n_wanted = max(1, round(BLOCK_SECONDS * self._rate))
        volts = np.empty((len(self._ends), n_wanted))
        was_behind = self._is_behind
        try:
            n = self._reader.read_many_sample(volts, n_wanted, timeout=READ_TIMEOUT)
        except DaqReadError as error:
            if error.error_code == DAQmxErrors.SAMPLES_NO_LONGER_AVAILABLE.value:
                self._skip()
                return None
            if error.error_code != DAQmxErrors.SAMPLES_NOT_YET_AVAILABLE.value:
                raise
            n = error.samps_per_chan_read  # those that came before the time was over
        if not n:
            return None
        if was_behind:
            self._stream.offset, self._is_behind = 0, False
        volts = volts[:, :n]
        return Samples(
            volts.T,
            position=self._stream.curr_read_pos - n,
            reason="overrun of the buffer of NI-DAQmx" if was_behind else "",
            flags=BlockFlag.CLIPPED if np.any(np.abs(volts) >= self._ends) else BlockFlag.NONE,
        )

    def _skip(self) -> None:
        """Go to the newer half of the buffer, for the read position was overwritten."""
        behind = self._stream.total_samp_per_chan_acquired - self._stream.curr_read_pos
        self._stream.offset, self._is_behind = behind - self._stream.input_buf_size // 2, True


class NiDriver(Driver[NiSettings]):
    """See :class:`daq.devices.interface.Driver`. Counts are volts."""

    name = "nidaqmx"
    summary = "analog inputs of National Instruments (NI-DAQmx), several sensors in one task"
    settings = NiSettings
    shares_clock = True
    dtype = np.float64

    def check(self, sensors: Sequence[Sensor]) -> dict[str, _Inputs]:
        """Return the inputs of each sensor."""
        settings = self.typed(sensors)

        def given(sensor: Sensor, used: Collection[str]) -> Sequence[str]:
            device = sensor.port.removeprefix(SCHEME)
            if not sensor.port.startswith(SCHEME) or not device or "/" in device:
                expected = (
                    "expected ni:// and the name of a device or chassis in NI MAX, such as"
                    " ni://cDAQ1"
                )
                raise sensor.fault("port", expected, sensor.port)
            names = settings[sensor.name].inputs
            names = names or tuple(f"ai{len(used) + k}" for k in range(len(sensor.channels)))
            return [f"{device}{'' if '/' in name else '/'}{name}" for name in names]

        names = inputs_of(sensors, given)
        return {name: _Inputs(names[name], one) for name, one in settings.items()}

    def ports(self) -> list[PresentPort]:
        """See :class:`daq.devices.interface.Listing`."""
        with _errors("devices of National Instruments"):
            from nidaqmx.system import System  # noqa: PLC0415 -- an extra

            devices = System.local().devices
            return [PresentPort(f"{SCHEME}{one.name}", one.product_type) for one in devices]

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[BlockingSource]:
        """Make the task; the calls of the library are made in threads."""
        inputs, label = self.check(sensors), port_label(sensors)
        with _errors(label):
            opened = await asyncio.to_thread(_opened, inputs, sensors[0].sampling_rate)
        task, ends, information = opened
        acquisition = Acquisition(task, ends)

        def read() -> Samples | None:
            with _errors(label):
                return acquisition.read()

        def start() -> None:
            with _errors(label):
                task.start()

        stop = partial(_quietly, task.stop)
        try:
            yield BlockingSource(
                sensors, clock, start=start, read=read, stop=stop, information=information
            )
        finally:
            await asyncio.to_thread(_quietly, task.close)


def _opened(
    inputs: dict[str, _Inputs], rate: float
) -> tuple[Any, list[float], list[DeviceInformation]]:
    """Return the task, the end of the range of each channel, and what the devices are."""
    import nidaqmx  # noqa: PLC0415 -- an extra
    from nidaqmx import constants  # noqa: PLC0415 -- an extra
    from nidaqmx.system import Device  # noqa: PLC0415 -- an extra

    task, ends = nidaqmx.Task(), []
    try:
        for one in inputs.values():
            end, settings = one.settings.range, one.settings
            terminal = constants.TerminalConfiguration[TERMINALS[settings.terminal]]
            for name in one.names:
                channel = task.ai_channels.add_ai_voltage_chan(
                    name, terminal_config=terminal, min_val=-end, max_val=end
                )
                if settings.coupling is not None:
                    channel.ai_coupling = constants.Coupling[settings.coupling.upper()]
                if settings.excitation is not None:
                    channel.ai_excit_src = constants.ExcitationSource.INTERNAL
                    current = constants.ExcitationVoltageOrCurrent.USE_CURRENT
                    channel.ai_excit_voltage_or_current = current
                    channel.ai_excit_val = settings.excitation
                ends.append(float(channel.ai_rng_high))
        mode = constants.AcquisitionType.CONTINUOUS
        n_kept = round(BUFFER_SECONDS * rate)
        task.timing.cfg_samp_clk_timing(rate, sample_mode=mode, samps_per_chan=n_kept)
        task.in_stream.overwrite = constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        actual, information = float(task.timing.samp_clk_rate), []
        for sensor, one in inputs.items():
            device, details = Device(one.device), {"inputs": ", ".join(one.names)}
            model, serial = device.product_type, f"{device.serial_num:X}"  # as on its label
            about = DeviceInformation(sensor, model, serial, sampling_rate=actual, details=details)
            information.append(about)
    except BaseException:
        _quietly(task.close)
        raise
    return task, ends, information


@contextlib.contextmanager
def _errors(label: str) -> Iterator[None]:
    """Raise what NI-DAQmx raises as an error of the port."""
    errors = package("nidaqmx.errors", "ni", label)
    try:
        yield
    except errors.Error as error:
        said = " ".join(str(error).split())
        raise NotConnectedError(f"{label}: {said}") from error


def _quietly(call: Any) -> None:  # noqa: ANN401
    """End a task whose device may be gone, which the read has said already."""
    from nidaqmx.errors import DaqError  # noqa: PLC0415 -- an extra

    with contextlib.suppress(DaqError):
        call()


DRIVER = NiDriver()
