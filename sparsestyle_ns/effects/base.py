"""What an effect is, and what has been decided about all of them.

An effect is a part of how a scene is simulated that some scenes need and others don't. It says what it measures of a
scene and builds what it needs; what is off is never built. `Decisions` is all that the rest of the package sees.
"""

import json
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Dict, List, Literal, Optional, Tuple

from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.utils.errors import InputError

EffectChoice = Literal["auto", "on", "off"]
Source = Literal["photos", "coarse field", "style image"]
FILE_NAME = "effects.json"


@dataclass(frozen=True)
class Measurement:
    """What an effect found out about a scene.

    Attributes:
        on: whether the scene calls for the effect.
        reason: why, in words.
        value: what was measured; None where nothing could be.
        threshold: what it was compared with; None where nothing is.
        parameters: numbers that building the effect needs, by name.
        possible: whether it could be built for this scene at all; else the reason says what is missing.
    """

    on: bool
    reason: str
    value: Optional[float] = None
    threshold: Optional[float] = None
    parameters: Dict[str, List[float]] = field(default_factory=dict)
    possible: bool = True


class Effect(ABC):
    """One effect: what it measures of a scene, and what it builds where it is on.

    Attributes:
        name: on the command line, `--pipeline.effects.NAME`.
        help: one line: what it is.
        source: what it is measured on; with "photos" it is decided before stage 1, and stage 2 takes it over.
        layout: whether it is one of the ways to lay space out, of which exactly one is on.
    """

    name: ClassVar[str]
    help: ClassVar[str]
    source: ClassVar[Source] = "photos"
    layout: ClassVar[bool] = False

    @abstractmethod
    def measure(self, scene: Scene) -> Measurement:
        """Measures a scene. Where what it is measured on isn't there yet, `on` is what is assumed until then."""

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> Any:
        """Makes the effect's module or value, called only where it is on; True for one that is a mere switch.

        Args:
            parameters: what `measure` found.
            needs: what the effect asks of the place where it is built.
        """
        return True


@dataclass(frozen=True)
class Decision:
    """Whether one effect is on, and why.

    Attributes:
        name: the effect's.
        on: whether it is simulated.
        measured, threshold: see `Measurement`.
        reason: in words.
        choice: what the command line said.
        parameters: see `Measurement`.
    """

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


COLUMNS = ("effect", "is", "measured", "threshold", "why")


@dataclass(frozen=True)
class Decisions:
    """What is simulated. Made by `decide` alone; everything else receives it."""

    items: Tuple[Decision, ...]

    def __getitem__(self, name: str) -> Decision:
        """The decision about an effect; off where a run is older than the effect."""
        unknown = Decision(name, False, None, None, "not known yet when this was decided")
        return next((item for item in self.items if item.name == name), unknown)

    def on(self, name: str) -> bool:
        """Whether an effect is simulated."""
        return self[name].on

    def on_photos(self) -> Dict[str, bool]:
        """Whether effects are on that photos alone decide, so that a coarse run and a stylised one must agree."""
        from sparsestyle_ns.effects.registry import EFFECTS

        return {item.name: item.on for item in self.items if EFFECTS[item.name].source == "photos"}

    def build(self, name: str, **needs: Any) -> Any:
        """What an effect builds; None where it is off. See `Effect.build`."""
        from sparsestyle_ns.effects.registry import EFFECTS

        decision = self[name]
        return EFFECTS[name].build(decision.parameters, **needs) if decision.on else None

    def build_space(self, **needs: Any) -> Any:
        """The space (`rendering.space.Space`) of the one layout that is on."""
        return self.build(self.layout, **needs)

    @property
    def layout(self) -> str:
        """The name of the effect that lays space out."""
        from sparsestyle_ns.effects.registry import EFFECTS

        return next(item.name for item in self.items if item.on and EFFECTS[item.name].layout)

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
        (folder / FILE_NAME).write_text(self.json(), encoding="utf-8")

    def json(self) -> str:
        """The decisions as JSON: a list `effects` of name, on, measured, threshold, reason, …"""
        return json.dumps({"effects": self.records()}, indent=1, ensure_ascii=False) + "\n"

    def rows(self) -> List[Tuple[str, ...]]:
        """The decisions as a table, its heading first."""
        return [COLUMNS, *(item.cells() for item in self.items)]

    def markdown(self) -> str:
        """The decisions as a Markdown table."""
        heading, *rows = self.rows()
        return "\n".join("| " + " | ".join(row) + " |" for row in [heading, ("---",) * len(COLUMNS), *rows])

    def text(self) -> str:
        """The decisions as a table for a terminal."""
        rows = self.rows()
        widths = [max(len(row[column]) for row in rows) for column in range(len(COLUMNS) - 1)]
        return "\n".join(
            "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in rows
        )

    def check_choices(self, settings: Any, whose: str) -> None:
        """Makes sure that settings don't ask for something else than was decided.

        Raises:
            InputError: they do.
        """
        for item in self.items:
            choice = getattr(settings, item.name)
            if choice != "auto" and (choice == "on") != item.on:
                raise InputError(
                    f"--pipeline.effects.{item.name} is {choice}, but {whose} has it {'on' if item.on else 'off'}; "
                    "leave it out, or train anew."
                )
