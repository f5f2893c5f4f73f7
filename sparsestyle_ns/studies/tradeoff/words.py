"""What was found, in plain words; every number comes from the measurements."""

from typing import List, Optional, Sequence

from sparsestyle_ns.studies.tradeoff.axis import Axis, Point
from sparsestyle_ns.studies.tradeoff.pareto import decibels_lost, time_factor_of_a_decibel

SMALL_GAIN = 0.05
"""Share of error or time below which two settings count as equally good."""
ALSO_KEEP = 1.1
"""How many times as fast another setting has to be before it is worth naming."""


def duration(seconds: float) -> str:
    """0.35 s, 40 s, 3:05 min."""
    if seconds < 10:
        return f"{seconds:.2g} s"
    if round(seconds) < 120:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d} min"


def times(factor: float) -> str:
    """4×, 1.7×."""
    return f"{factor:.0f}×" if factor >= 9.5 else f"{factor:.2g}×"


def recommendation(axes: Sequence[Axis]) -> List[str]:
    """A line for stage 1, a line for stage 2, then one for each setting."""
    lines = []
    for axis in axes:
        if axis.name == "stage-1 iterations":
            lines += stage1_lines(axis)
        elif axis.name == "stage-2 iterations":
            lines += stage2_lines(axis)
        elif axis.points:
            lines.append(setting_line(axis) + order_in_words(axis))
    return lines


def stage1_lines(axis: Axis) -> List[str]:
    """draft: 40 s, 19.1 dB; standard: …; beyond that 1 dB costs 4×."""
    draft, front = axis.recommended, axis.front
    if draft is None:
        return []
    best = front[-1]
    parts = [f"draft: {_psnr_after(draft)}"]
    if best is not draft:
        parts.append(f"standard: {_psnr_after(best)}")
    factor = _last_factor(front)
    if factor is not None:
        parts.append(f"beyond that 1 dB costs {times(factor)} the time")
    return [f"Stage 1 ({axis.flag}): " + "; ".join(parts) + _mark(draft, best)]


def _psnr_after(point: Point) -> str:
    seconds, psnr = point.median("train_seconds"), point.median("psnr")
    return f"{duration(seconds)}, {psnr:.1f} dB ({point.setting} iterations)"


def _last_factor(front: Sequence[Point]) -> Optional[float]:
    """What a decibel costs at the end of the front."""
    if len(front) < 2:
        return None
    earlier, later = ((point.median("train_seconds"), point.median("psnr")) for point in front[-2:])
    return time_factor_of_a_decibel(*earlier, *later)


def stage2_lines(axis: Axis) -> List[str]:
    """Style loss after the recommended number of iterations, and after the best one."""
    draft, best = axis.recommended, axis.front[-1] if axis.points else None
    if draft is None or best is None:
        return []
    parts = [f"draft: {_loss_after(draft)}"]
    if best is not draft:
        parts.append(f"standard: {_loss_after(best)}")
    return [f"Stage 2 ({axis.flag}): " + "; ".join(parts) + _mark(draft, best)]


def _loss_after(point: Point) -> str:
    seconds, loss = point.median("train_seconds"), point.median("style_loss")
    return f"{duration(seconds)}, style loss {loss:.3f} ({point.setting} iterations)"


def setting_line(axis: Axis) -> str:
    """Whether to keep the preset's value, and what another would change."""
    chosen = axis.recommended
    assert chosen is not None
    preset = axis.last(axis.preset)
    head = f"{axis.title} ({axis.flag}): "
    if preset is None:
        return f"{head}{chosen.setting}; the preset's {axis.preset} wasn't measured" + _mark(chosen)
    if chosen.setting == preset.setting:
        return f"{head}keep {preset.setting}{_instead(axis, preset)}" + _mark(chosen, preset)
    # Runs of one length end at the same time: their ends are what can be compared.
    chosen = axis.last(chosen.setting) or chosen
    compared = f"{_compared(axis, chosen, preset)}" + _mark(chosen, preset)
    if is_worth_a_change(axis, chosen, preset):
        return f"{head}{chosen.setting} instead of {preset.setting}: {compared}"
    return f"{head}keep {preset.setting}; {chosen.setting}: {compared}"


def is_worth_a_change(axis: Axis, chosen: Point, preset: Point) -> bool:
    """Whether a setting is faster or more accurate than the preset's by more than measurements wander."""
    if preset.median(axis.time) / chosen.median(axis.time) > ALSO_KEEP:
        return True
    if axis.own_error is not None:
        return axis.error_of(preset) > axis.free_error
    return axis.error_of(chosen) < (1.0 - SMALL_GAIN) * axis.error_of(preset)


def order_in_words(axis: Axis) -> str:
    """How fast the error falls with the samples, where that was observed."""
    return "" if axis.order is None else f" Observed order of convergence: {axis.order:.1f}."


def _instead(axis: Axis, preset: Point) -> str:
    """What the next faster setting on the front would cost."""
    front = axis.front
    if axis.has_runs or preset not in front or front.index(preset) == 0:
        return ""
    faster = front[front.index(preset) - 1]
    if preset.median(axis.time) / faster.median(axis.time) < ALSO_KEEP:
        return ""
    return f"; {faster.setting} would be {_compared(axis, faster, preset)}"


def _compared(axis: Axis, point: Point, other: Point) -> str:
    """1.9× as fast, 0.02 dB worse."""
    factor = other.median(axis.time) / point.median(axis.time)
    parts = []
    if abs(factor - 1.0) > SMALL_GAIN:
        speed = f"{times(factor)} as fast" if factor > 1 else f"{times(1 / factor)} the time"
        parts.append(speed)
    if axis.own_error is not None:
        lost = [decibels_lost(axis.error_of(one), axis.own_error) for one in (point, other)]
        parts.append(f"costs {lost[0]:.2g} dB against photos instead of {lost[1]:.2g}")
    elif axis.error == "psnr":
        parts.append(f"{point.median('psnr'):.2f} dB instead of {other.median('psnr'):.2f}")
    else:
        parts.append(f"{axis.error.replace('_', ' ')} {axis.error_of(point):.3f} instead of {axis.error_of(other):.3f}")
    return ", ".join(parts)


def _mark(*points: Point) -> str:
    """A remark where the figures are weak."""
    remarks = []
    if all(max(map(len, point.values.values())) < 2 for point in points):
        remarks.append("measured once")
    if any(point.busy for point in points):
        remarks.append("the machine was busy")
    return f" [{'; '.join(remarks)}]" if remarks else "."
