"""What was found, in plain words; every number comes from the measurements."""

from typing import List, Sequence

from sparsestyle_ns.studies.curves import Curve, Point, decibels_lost, time_factor_of_a_decibel
from sparsestyle_ns.utils import progress

SMALL_GAIN = 0.05
"""Share of error or time below which two settings count as equally good."""
ALSO_KEEP = 1.1
"""How many times as fast another setting has to be before it is worth naming."""


def rounded_duration(seconds: float) -> str:
    """0.35 s, 40 s, 3:05 min."""
    if seconds < 10:
        return f"{seconds:.2g} s"
    return f"{seconds:.0f} s" if round(seconds) < 120 else progress.duration(seconds)


def times(factor: float) -> str:
    """4×, 1.7×."""
    return f"{factor:.0f}×" if factor >= 9.5 else f"{factor:.2g}×"


def recommendation(curves: Sequence[Curve]) -> List[str]:
    """A line for each curve, all of which have points: how long to train, and what to turn."""
    return [iterations_line(curve) if curve.flag == "--max-num-iterations" else setting_line(curve) for curve in curves]


def iterations_line(curve: Curve) -> str:
    """How many iterations are enough for a draft, how many gave the best result, and what more would cost."""
    draft, front = curve.recommended, curve.front
    uses = {"for a draft": draft} if draft is front[-1] else {"for a draft": draft, "for the best result": front[-1]}
    words = ", ".join(f"{point.setting} {use} ({_result(curve, point)})" for use, point in uses.items())
    if curve.error == "psnr" and len(front) > 1:
        ends = [(point.median("train_seconds"), point.median("psnr")) for point in front[-2:]]
        # On a front both grow, so there is a factor.
        words += f"; after that 1 dB more takes {times(time_factor_of_a_decibel(*ends[0], *ends[1]))} the time"
    return f"{curve.title} ({curve.flag}): {words}{_remarks(draft, front[-1])}"


def _result(curve: Curve, point: Point) -> str:
    value = point.median(curve.error)
    quality = f"{value:.1f} dB" if curve.error == "psnr" else f"style loss {value:.3f}"
    return f"{rounded_duration(point.median(curve.time))}, {quality}"


def setting_line(curve: Curve) -> str:
    """Whether to keep the preset's value, and what another would change."""
    # Runs of one length end at the same time: their ends are what can be compared.
    chosen, preset = curve.last(curve.recommended.setting), curve.last(curve.preset)
    if preset is None:
        words = f"use {chosen.setting}; the preset's {curve.preset} wasn't measured"
    elif chosen.setting == preset.setting:
        words = f"keep {preset.setting}{_faster_one(curve, preset)}"
    elif is_worth_a_change(curve, chosen, preset):
        words = f"{chosen.setting} instead of {preset.setting}: {_compared(curve, chosen, preset)}"
    else:
        words = f"keep {preset.setting}; {chosen.setting} would be no better: {_compared(curve, chosen, preset)}"
    remarks = _remarks(chosen, *([preset] if preset else []))
    return f"{curve.title} ({curve.flag}): {words}{remarks}{_convergence(curve)}"


def _convergence(curve: Curve) -> str:
    """Of a curve over numbers of samples: the errors, and how fast they fall."""
    if curve.order is None:
        return ""
    errors = ", ".join(f"{curve.error_of(point):.2g} with {point.setting}" for point in curve.points)
    return f" Errors: {errors}. Observed order of convergence: {curve.order:.1f}."


def is_worth_a_change(curve: Curve, chosen: Point, preset: Point) -> bool:
    """Whether a setting is faster or more accurate than the preset's by more than measurements wander."""
    if preset.median(curve.time) / chosen.median(curve.time) > ALSO_KEEP:
        return True
    if curve.own_error is not None:
        return curve.error_of(preset) > curve.free_error
    return curve.error_of(chosen) < (1.0 - SMALL_GAIN) * curve.error_of(preset)


def _faster_one(curve: Curve, preset: Point) -> str:
    """What the next faster setting on the front would cost."""
    front = curve.front
    if curve.has_runs or preset not in front or front.index(preset) == 0:
        return ""
    faster = front[front.index(preset) - 1]
    if preset.median(curve.time) / faster.median(curve.time) < ALSO_KEEP:
        return ""
    return f"; {faster.setting} would be {_compared(curve, faster, preset)}"


def _compared(curve: Curve, point: Point, other: Point) -> str:
    """1.9× as fast, 19.00 dB instead of 18.00."""
    factor, parts = other.median(curve.time) / point.median(curve.time), []
    if abs(factor - 1.0) > SMALL_GAIN:
        parts.append(f"{times(factor)} as fast" if factor > 1 else f"{times(1 / factor)} the time")
    if curve.own_error is not None:
        lost = [decibels_lost(curve.error_of(one), curve.own_error) for one in (point, other)]
        parts.append(f"costs {lost[0]:.2g} dB against photos instead of {lost[1]:.2g}")
    elif curve.error == "psnr":
        parts.append(f"{point.median('psnr'):.2f} dB instead of {other.median('psnr'):.2f}")
    else:
        error = curve.error.replace("_", " ")
        parts.append(f"{error} {curve.error_of(point):.3f} instead of {curve.error_of(other):.3f}")
    return ", ".join(parts)


def _remarks(*points: Point) -> str:
    """The end of a line: what makes its figures weak, if anything does."""
    once = all(max(map(len, point.values.values())) < 2 for point in points)
    remarks = {"measured once": once, "the machine was busy": any(point.busy for point in points)}
    said = "; ".join(remark for remark, holds in remarks.items() if holds)
    return f" [{said}]" if said else "."
