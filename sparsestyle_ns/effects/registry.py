"""All effects in the order of the table, the settings that follow from them, and the one place that decides."""

from dataclasses import field, make_dataclass
from typing import Annotated, Any, Dict, Optional

import tyro

from sparsestyle_ns.effects.background import Background
from sparsestyle_ns.effects.base import Decision, Decisions, Effect, EffectChoice, Measurement
from sparsestyle_ns.effects.empty_space import EmptySpace
from sparsestyle_ns.effects.exposure import Exposure
from sparsestyle_ns.effects.layouts import BoundedBox, Contraction, ForwardFacing
from sparsestyle_ns.effects.lens_distortion import LensDistortion
from sparsestyle_ns.effects.matched_depth import MatchedDepth
from sparsestyle_ns.effects.palette import Palette
from sparsestyle_ns.effects.residual_density import ResidualDensity
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.effects.view_color import ViewColor
from sparsestyle_ns.utils.errors import InputError

EFFECTS: Dict[str, Effect] = {
    effect.name: effect
    for effect in (
        ForwardFacing(),
        BoundedBox(),
        Contraction(),
        Background(),
        ViewColor(),
        Exposure(),
        LensDistortion(),
        MatchedDepth(),
        EmptySpace(),
        ResidualDensity(),
        Palette(),
    )
}

LAYOUTS = tuple(name for name, effect in EFFECTS.items() if effect.layout)
"""Effects of which exactly one is on."""

EffectSettings = make_dataclass(
    "EffectSettings",
    [
        (name, Annotated[EffectChoice, tyro.conf.arg(help=effect.help)], field(default="auto"))
        for name, effect in EFFECTS.items()
    ],
    namespace={"__doc__": "Which effects are simulated; auto measures whether the scene calls for them."},
    frozen=True,
)
EffectSettings.__module__ = __name__  # config.yml names the class by it
ALL_AUTO = EffectSettings()
"""Every effect is measured."""


def decide(scene: Scene, settings: Any, inherited: Optional[Decisions] = None) -> Decisions:
    """Decides about all effects.

    Args:
        scene: what to measure.
        settings: an `EffectSettings`.
        inherited: decisions of the coarse run that a stylised one builds on. What is measured on photos is taken from
            them; the rest is decided now.

    Raises:
        InputError: an effect is asked for that can't be had, or there isn't exactly one layout of space.
    """
    if inherited is not None:
        taken = Decisions(tuple(inherited[name] for name, effect in EFFECTS.items() if effect.source == "photos"))
        taken.check_choices(settings, "the coarse run")
        new = {name: effect.measure(scene) for name, effect in EFFECTS.items() if effect.source != "photos"}
        made = {item.name: item for item in taken.items}
    else:
        new, made = {name: effect.measure(scene) for name, effect in EFFECTS.items()}, {}
        layout = _layout_decision(new, settings)
        made[layout.name] = layout
        for name in LAYOUTS:
            reason = new[name].reason if not new[name].on else f"{layout.name} lays space out"
            made.setdefault(name, _decision(name, new[name], getattr(settings, name), on=False, reason=reason))
    for name in new.keys() - made.keys():
        made[name] = settle(name, new[name], getattr(settings, name))
    return Decisions(tuple(made[name] for name in EFFECTS))


def decide_again(decisions: Decisions, name: str, scene: Scene) -> Decisions:
    """The decisions with one of them made anew on what is known of the scene now; not where it was asked for."""
    choice = decisions[name].choice
    return decisions if choice != "auto" else decisions.replaced(settle(name, EFFECTS[name].measure(scene), choice))


def settle(name: str, found: Measurement, choice: EffectChoice) -> Decision:
    """The decision about one effect that depends on no other.

    Raises:
        InputError: it is asked for and can't be had.
    """
    if choice == "auto":
        return _decision(name, found, choice, found.on and found.possible)
    if choice == "on" and not found.possible:
        raise InputError(f"--pipeline.effects.{name} can't be on: {found.reason}; leave it out.")
    return _decision(name, found, choice, choice == "on", f"asked for ({found.reason})")


def _layout_decision(found: Dict[str, Measurement], settings: Any) -> Decision:
    """Which of the layouts is on: the one that is asked for, else the first in the table that the scene calls for."""
    asked = [name for name in LAYOUTS if getattr(settings, name) == "on"]
    if len(asked) > 1:
        raise InputError(f"--pipeline.effects has {' and '.join(asked)} on, but space has one layout; name only one.")
    if asked:
        return settle(asked[0], found[asked[0]], "on")
    for name in LAYOUTS:
        if getattr(settings, name) == "auto" and found[name].on and found[name].possible:
            return settle(name, found[name], "auto")
    raise InputError(
        "--pipeline.effects turns off every layout of space that this scene calls for; turn one on: "
        + ", ".join(name for name in LAYOUTS if found[name].possible)
        + "."
    )


def _decision(name: str, found: Measurement, choice: EffectChoice, on: bool, reason: Optional[str] = None) -> Decision:
    return Decision(name, on, found.value, found.threshold, reason or found.reason, choice, found.parameters)
