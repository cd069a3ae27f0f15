# SPDX-License-Identifier: Apache-2.0
"""All frames smoothed as much as the run itself shows that smoothing helps, and no more."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse.linalg import spsolve

from slam.geometry import se3
from slam.types import FloatArray, IntArray, Trajectory

# Over a longer time without a frame nothing is known of the motion.
_LONGEST_GAP_S = 0.2
_SHORTEST_STEP_S = 1e-3  # of frames stamped as they arrive, in a burst, time tells nothing

# Frames that are judged together, half of them again with the next ones. Fewer tell noise from
# motion too badly; over more a swing's frequency wanders, and it passes for noise.
_WINDOW = 64
_FEWEST = 160  # Fewer than four windows cannot tell how well frames are placed.
# Smoothing strengths that are tried, in squared frame intervals: from nothing to half a window.
_STRENGTHS = np.logspace(-1.0, 2.5, 15)
_FAST = 0.25  # the slowest quarter of a window's modes holds too much motion to tell its noise
_BAND = 12  # modes in a row whose mean is compared with that of other bands
_SWINGS = 2  # steady ones that are taken out before
# The least band of white noise holds 0.60 of its variance on average, in a tenth of the windows no
# more than 0.45. What is taken for the noise stays below it: that costs a little smoothing, the
# opposite costs motion.
_NOISE_FACTOR = 1.5
_CALM_SHARE = 0.1
_MEDIAN_OF_SQUARES = 0.455  # of a standard normal number


class _Spectrum(NamedTuple):
    """A window's values as a sum of modes, from a steady motion to one that turns every frame.

    Attributes:
        rows: of the second differences between the window's frames.
        stiffness: (N,) s^-4, how much each mode accelerates.
        energy: (N,) each mode's share of the values' sum of squares.
        noise: estimated variance of a frame, all its values together.
        step_s: between two frames.
    """

    rows: slice
    stiffness: FloatArray
    energy: FloatArray
    noise: float
    step_s: float


def smoothed(trajectory: Trajectory, breaks_s: Sequence[float] = ()) -> Trajectory:
    """Return the trajectory without that part of the frames' noise that can be told from motion.

    The sum of squared changes and of squared, weighted second differences in time becomes least:
    of positions along the three axes of the world, and of rotations as unit quaternions. Window by
    window the weight is the one with the least expected error by Stein's unbiased risk estimate
    (Annals of Statistics 9, 1981), zero if that is no smoothing at all. How well single frames are
    placed is the level that white noise adds to all frequencies alike, and so at most the lowest
    level found: a bobbing head or a vibrating robot stands out at some frequencies, a bend or a
    stop at some times. What a tracker's errors have in common from frame to frame is not noise.

    Args:
        trajectory: of frames that are placed one by one.
        breaks_s: the first frame from each of these times on may be anywhere. So may one that comes
            more than 0.2 s after the one before.
    """
    if len(trajectory) < _FEWEST:
        return trajectory
    times_s = trajectory.timestamps_s - trajectory.timestamps_s[0]
    stretches = np.searchsorted(np.sort(breaks_s), trajectory.timestamps_s, side="right")
    first, differences = _second_differences(times_s, stretches)
    T_world_cam = trajectory.T_world_cam.copy()
    quaternions = _quaternions(T_world_cam[:, :3, :3])
    T_world_cam[:, :3, 3] = _least_wrong(T_world_cam[:, :3, 3], times_s, first, differences)
    quaternions = _least_wrong(quaternions, times_s, first, differences)
    T_world_cam[:, :3, :3] = se3.from_quaternion(quaternions)  # of whatever length
    return Trajectory(trajectory.timestamps_s, T_world_cam)


def _second_differences(
    times_s: FloatArray, stretches: IntArray
) -> tuple[IntArray, scipy.sparse.csr_array]:
    """Return the (M, N) second differences in time, and the first of the three frames of each."""
    steps_s = np.maximum(np.diff(times_s), _SHORTEST_STEP_S)
    before_s, after_s = steps_s[:-1], steps_s[1:]
    is_close = np.maximum(before_s, after_s) <= _LONGEST_GAP_S
    first = np.flatnonzero(is_close & (stretches[2:] == stretches[:-2]))
    before_s, after_s = before_s[first], after_s[first]
    both_s = before_s + after_s
    factors = 2.0 * np.column_stack(
        [1.0 / (before_s * both_s), -1.0 / (before_s * after_s), 1.0 / (after_s * both_s)]
    )
    columns = first[:, None] + np.arange(3)
    rows = np.repeat(np.arange(len(first)), 3)
    shape = (len(first), len(times_s))
    matrix = scipy.sparse.csr_array((factors.ravel(), (rows, columns.ravel())), shape=shape)
    return first, matrix


def _least_wrong(
    values: FloatArray, times_s: FloatArray, first: IntArray, differences: scipy.sparse.csr_array
) -> FloatArray:
    """Return the (N, D) values that are expected to be nearest the true ones."""
    size = min(_WINDOW, len(values))
    starts = {*range(0, len(values) - size, size // 2), len(values) - size}
    windows = []
    for start in sorted(starts):
        rows = slice(*np.searchsorted(first, [start, start + size - 2]).tolist())
        if rows.stop - rows.start >= size // 2:  # else there is more between the stretches
            frames = slice(start, start + size)
            part = differences[rows, frames].toarray()
            windows.append(_spectrum(values[frames], times_s[frames], part, rows))
    if not windows:
        return values
    noise = float(np.quantile([each.noise for each in windows], _CALM_SHARE))
    weights = np.full(len(first), np.inf)
    for each in windows:
        weights[each.rows] = np.minimum(weights[each.rows], _best_weight(each, noise))
    weights[np.isinf(weights)] = 0.0
    bending = differences.T @ scipy.sparse.diags_array(weights) @ differences
    information = scipy.sparse.eye_array(len(values)) + bending
    return np.asarray(spsolve(information.tocsc(), values), np.float64)


def _best_weight(spectrum: _Spectrum, noise: float) -> float:
    """Return the weight of squared second differences, s^4, with the least expected error."""
    weights = (_STRENGTHS * spectrum.step_s**2) ** 2
    removed = 1.0 - 1.0 / (1.0 + weights[:, None] * spectrum.stiffness)
    gains = (2.0 * noise * removed - removed**2 * spectrum.energy).sum(axis=1)
    best = int(gains.argmax())
    return float(weights[best]) if gains[best] > 0.0 else 0.0


def _spectrum(
    values: FloatArray, times_s: FloatArray, differences: FloatArray, rows: slice
) -> _Spectrum:
    """Take the (N, D) values of a window apart; its (M, N) second differences say how they bend."""
    values = values - values.mean(axis=0)
    bending = differences.T @ differences
    diagonals = [np.append(np.diag(bending, -each), np.zeros(each)) for each in range(3)]
    stiffness, modes = scipy.linalg.eig_banded(np.array(diagonals), lower=True)
    amplitudes = modes.T @ values
    step_s = float(np.median(np.diff(times_s)))
    fast = slice(int(_FAST * len(values)), None)
    unsteady = _without_swings(amplitudes[fast], modes[:, fast], times_s, step_s)
    energy = (unsteady**2).sum(axis=1)
    bands = energy[len(energy) % _BAND :].reshape(-1, _BAND).mean(axis=1)
    # In a bend or a jump all frequencies stand out, but few second differences.
    gain = np.linalg.norm(differences, axis=1, keepdims=True)
    squares = np.median((differences @ values / gain) ** 2, axis=0)
    noise = min(_NOISE_FACTOR * bands.min(), squares.sum() / _MEDIAN_OF_SQUARES)
    return _Spectrum(
        rows, np.maximum(stiffness, 0.0), (amplitudes**2).sum(axis=1), float(noise), step_s
    )


def _without_swings(
    amplitudes: FloatArray, modes: FloatArray, times_s: FloatArray, step_s: float
) -> FloatArray:
    """Return (K, D) amplitudes of the (N, K) modes less the sine waves that explain most of them.

    A sine wave that is sampled at uneven times is in all modes alike, as noise is.
    """
    count = len(times_s)
    frequencies_hz = np.arange(1, 2 * count) / (2.0 * count * step_s)
    phases = 2.0 * np.pi * np.outer(times_s, frequencies_hz)
    waves = np.stack([modes.T @ np.sin(phases), modes.T @ np.cos(phases)]).transpose(2, 1, 0)
    for _ in range(_SWINGS):
        products = np.swapaxes(waves, 1, 2) @ waves
        size = np.trace(products, axis1=1, axis2=2)
        products += (1e-6 * size + 1e-12)[:, None, None] * np.eye(2)  # sine and cosine may be one
        along = np.swapaxes(waves, 1, 2) @ amplitudes
        explained = (along * np.linalg.solve(products, along)).sum(axis=(1, 2))
        explained[size < 1e-3] = 0.0
        swing, _ = np.linalg.qr(waves[explained.argmax()])
        amplitudes = amplitudes - swing @ (swing.T @ amplitudes)
        waves = waves - swing @ (swing.T @ waves)
    return amplitudes


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Return the (N, 4) quaternions of rotations, each of the two that is nearer the one before."""
    quaternions = se3.to_quaternion(rotations)
    turns_over = np.einsum("nd,nd->n", quaternions[1:], quaternions[:-1]) < 0.0
    signs = np.cumprod(np.where(turns_over, -1.0, 1.0))
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[:, None]])
