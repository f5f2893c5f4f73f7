"""How the command line sets effects, what is measured for one, and what was decided about all of them.

An effect is a part of the simulation that some scenes need and others don't. What is off is never built.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Dict, List, Literal, Optional, Tuple

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import write_whole

EffectChoice = Literal["auto", "on", "off"]


@dataclass(frozen=True)
class EffectSettings:
    """Which effects are simulated: auto measures whether the scene needs them, on and off overrule the measurement."""

    ndc: EffectChoice = "auto"
    """Normalised device coordinates: for cameras that all face one way, with things at any depth before them."""
    box: EffectChoice = "auto"
    """Bounded box: for an object with nothing behind it, seen from all around."""
    contraction: EffectChoice = "auto"
    """Contracted unbounded space: for a scene with a background on all sides."""
    background: EffectChoice = "auto"
    """Background colour: for photos with transparency, or with a border of one colour."""
    view_color: EffectChoice = "auto"
    """View-dependent colour: where a point's colour differs between photos by more than noise and exposure explain."""
    exposure: EffectChoice = "auto"
    """Exposure and white balance of each photo: where photos differ in brightness or tint."""
    lens_distortion: EffectChoice = "auto"
    """Lens distortion: where the cameras' distortion parameters move pixels."""
    matched_depth: EffectChoice = "auto"
    """Depth of points that two photos share, found by matching."""
    pose_refinement: EffectChoice = "auto"
    """Cameras learned with the field: where rays to points that two photos share miss each other."""
    empty_space: EffectChoice = "auto"
    """Empty-space skipping: where enough of space is empty; decided again while stage 1 trains."""
    residual_density: EffectChoice = "auto"
    """Residual density in stage 2, as in the paper; off where the coarse geometry can be trusted."""
    palette: EffectChoice = "auto"
    """Palette transfer: where the painting's colours differ from the photos'."""


@dataclass(frozen=True)
class Measurement:
    """What was measured of a scene for one effect.

    Attributes:
        on: whether the scene needs the effect; an assumption where what it measures isn't there yet.
        reason: why. Where there is a value, the text goes on from it: "0.31", "of space is empty".
        value: what was measured; None where nothing could be.
        threshold: what it was compared with.
        parameters: numbers that building the effect needs, by name.
        possible: whether the effect can be simulated for this scene at all; if not, the reason says what is missing.
    """

    on: bool
    reason: str
    value: Optional[float] = None
    threshold: Optional[float] = None
    parameters: Dict[str, List[float]] = field(default_factory=dict)
    possible: bool = True


@dataclass(frozen=True)
class Decision:
    """Whether one effect is simulated, and why: what was measured (see `Measurement`), and what the user chose."""

    name: str
    on: bool
    measured: Optional[float]
    threshold: Optional[float]
    reason: str
    choice: EffectChoice = "auto"
    parameters: Dict[str, List[float]] = field(default_factory=dict)

    def cells(self) -> Tuple[str, str, str, str, str]:
        """The decision as a line of a table: effect, on, measured, threshold, why."""
        measured, threshold = ("–" if value is None else f"{value:.3g}" for value in (self.measured, self.threshold))
        return self.name, "on" if self.on else "off", measured, threshold, self.reason


@dataclass(frozen=True)
class Decisions:
    """What is simulated: one decision for each effect, as `registry.decide` made it."""

    items: Tuple[Decision, ...]

    def __getitem__(self, name: str) -> Decision:
        return {item.name: item for item in self.items}[name]

    def on(self, name: str) -> bool:
        """Whether an effect is simulated; one that these decisions are older than isn't."""
        return any(item.on for item in self.items if item.name == name)

    def replaced(self, decision: Decision) -> "Decisions":
        """The same decisions but one."""
        return Decisions(tuple(decision if item.name == decision.name else item for item in self.items))

    def records(self) -> List[Dict[str, Any]]:
        """The decisions as plain values, for JSON and checkpoints."""
        return [asdict(item) for item in self.items]

    @classmethod
    def from_records(cls, records: List[Dict[str, Any]]) -> "Decisions":
        """The inverse of `records`."""
        return cls(tuple(Decision(**record) for record in records))

    def save(self, folder: Path) -> None:
        """Writes `effects.json` into a run's folder."""
        write_whole(folder / "effects.json", self.json())

    def json(self) -> str:
        """The decisions as JSON: a list `effects` of name, on, measured, threshold, reason, …"""
        return json.dumps({"effects": self.records()}, indent=1, ensure_ascii=False) + "\n"

    def rows(self) -> List[Tuple[str, ...]]:
        """The decisions as a table's lines, the first of them its heading."""
        return [("effect", "is", "measured", "threshold", "why"), *(item.cells() for item in self.items)]

    def text(self) -> str:
        """The decisions as a table for a terminal."""
        rows = self.rows()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)

    def check_choices(self, settings: EffectSettings, whose: str) -> None:
        """Raises an `InputError` if the command line contradicts what was decided by `whose`, in words."""
        for item in self.items:
            choice = getattr(settings, item.name)
            if choice != "auto" and (choice == "on") != item.on:
                raise InputError(
                    f"--pipeline.effects.{item.name} is {choice}, but {whose} has it {'on' if item.on else 'off'}; "
                    "leave it out, or train anew."
                )
