"""How two sensors stand to each other, in words: turned, skewed, swapped, reversed, late."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.wording import Advice, signed

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.diagnostics.relative_response import RelativeResponse

TURNED_DEG = 0.5
SKEWED_DEG = 2.0
GAIN = 0.02
DELAY_SAMPLES = 0.1


def _swapped(response: RelativeResponse) -> dict[int, int]:
    """Channels of the second sensor that follow another channel of the first, and which.

    Only if two trade places: three that do, or two of which one is reversed, are as well a sensor
    that is turned.
    """
    if not response.reversed_channels:
        return {}
    direction = response.matrix / np.linalg.norm(response.matrix, axis=1)[:, None]
    follows = np.argmax(np.abs(direction), axis=1)
    moved = [c for c, other in enumerate(follows) if c != other]
    along = direction[np.arange(len(follows)), follows]
    if len(moved) != 2 or follows[moved].tolist() != moved[::-1] or along.min() < np.sqrt(0.5):
        return {}
    return {c: int(follows[c]) for c in moved}


def stance(
    response: RelativeResponse,
    names: tuple[str, ...],
    channels: tuple[str, ...],
    dims: tuple[int, ...],
    nyquist: float,
) -> Iterator[Advice]:
    """Put into words how one sensor stands to another."""
    pair = (response.first, response.second)
    band = (response.low, response.high)
    one, two = (names[sensor] for sensor in pair)
    own = [f"{two}.{name}" for name in channels[sum(dims[: pair[1]]) :][: dims[pair[1]]]]
    like = [f"{one}.{name}" for name in channels[sum(dims[: pair[0]]) :][: dims[pair[0]]]]
    error = response.angle_error_deg
    swapped = _swapped(response)
    if swapped:
        follows = ", ".join(f"{own[c]} moves as {like[swapped[c]]} does" for c in swapped)
        yield Advice(
            "warning",
            pair,
            band,
            f"Channels are swapped: {follows}. No bias in the three-sensor or maximum "
            "likelihood estimate, but the noise stands under the wrong names, and other methods "
            "compare what does not belong together.",
            {"swapped": float(len(swapped))},
            "Look at the order of channels in the bench file, and at the cables.",
        )
        return
    if response.rotation_deg > max(TURNED_DEG, 3 * error if np.isfinite(error) else 0.0):
        horizontal = response.horizontal_deg
        where = f" ({signed(horizontal, '.2f')}° in the horizontal)"
        yield Advice(
            "note",
            pair,
            band,
            f"Sensors {one} and {two} are turned by {response.rotation_deg:.1f}°"
            f"{where if np.isfinite(horizontal) else ''}: no bias in the three-sensor or maximum "
            "likelihood estimate, but a three-channel or two-channel estimate leaks motion.",
            {"angle_deg": response.rotation_deg, "horizontal_deg": horizontal, "error_deg": error},
            "Aligning them can improve precision.",
        )
    if response.nonorthogonality_deg > SKEWED_DEG:
        yield Advice(
            "warning" if response.nonorthogonality_deg > 20 else "note",
            pair,
            band,
            f"Channels of sensors {one} or {two} are {response.nonorthogonality_deg:.1f}° away "
            "from a right angle: no bias, but the noise estimate scatters more the more "
            "collinear they are.",
            {"nonorthogonality_deg": response.nonorthogonality_deg},
            "Channels at right angles are best.",
        )
    for channel in response.reversed_channels:
        yield Advice(
            "warning",
            pair,
            band,
            f"{own[channel]} has the opposite polarity of {like[channel]}: no bias in the "
            "three-sensor or maximum likelihood estimate, but its sensitivity has the wrong sign.",
            {"channel": float(channel + 1)},
            "Give it the opposite sign in the bench file, or swap its wires.",
        )
    off = int(np.argmax(np.abs(response.gains - 1)))
    if abs(response.gains[off] - 1) > GAIN:
        yield Advice(
            "note",
            pair,
            band,
            f"{own[off]} reads {response.gains[off]:.3f} times what {like[off]} would: no bias, "
            "but one of the two sensitivities is wrong, and with it the noise in physical units.",
            {
                "gain": float(response.gains[off]),
                "of channel": float(sum(dims[: pair[1]]) + off),
                "against channel": float(sum(dims[: pair[0]]) + off),
            },
            "Look at the sensitivities in the bench file.",
        )
    samples = response.delay * 2 * nyquist
    if abs(samples) > DELAY_SAMPLES:
        late, early = (two, one) if samples > 0 else (one, two)
        yield Advice(
            "warning",
            pair,
            band,
            f"Sensor {late} lags sensor {early} by {abs(response.delay) * 1e3:.3g} ms "
            f"({abs(samples):.2g} samples): segments then differ at their ends.",
            {"delay_s": response.delay, "samples": samples},
            "Align the clocks, and use a tapered window.",
        )
