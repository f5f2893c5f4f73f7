"""All effects, in the order of the table, and the one place that decides about them."""

from typing import Dict, Optional

from sparsestyle_ns.effects.background import BACKGROUND
from sparsestyle_ns.effects.base import Decision, Decisions, Effect, EffectChoice, EffectSettings, Measurement
from sparsestyle_ns.effects.empty_space import EMPTY_SPACE
from sparsestyle_ns.effects.exposure import EXPOSURE
from sparsestyle_ns.effects.layouts import LAYOUTS
from sparsestyle_ns.effects.lens_distortion import LENS_DISTORTION
from sparsestyle_ns.effects.matched_depth import MATCHED_DEPTH
from sparsestyle_ns.effects.palette import PALETTE
from sparsestyle_ns.effects.residual_density import RESIDUAL_DENSITY
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.effects.view_color import VIEW_COLOR
from sparsestyle_ns.utils.errors import InputError

EFFECTS: Dict[str, Effect] = {
    effect.name: effect
    for effect in (
        *LAYOUTS,
        BACKGROUND,
        VIEW_COLOR,
        EXPOSURE,
        LENS_DISTORTION,
        MATCHED_DEPTH,
        EMPTY_SPACE,
        RESIDUAL_DENSITY,
        PALETTE,
    )
}


def decide(scene: Scene, settings: EffectSettings, inherited: Optional[Decisions] = None) -> Decisions:
    """Decides about all effects.

    Args:
        scene: what to measure.
        settings: what the command line asks for.
        inherited: the decisions of the coarse run that a stylised run builds on. Those on photos are taken over; the
            rest is decided now.

    Raises:
        InputError: an effect is asked for that can't be had, there isn't exactly one layout of space, or the settings
            contradict the coarse run.
    """
    if inherited is None:
        made = _decide_layouts(scene, settings)
    else:
        made = {name: inherited[name] for name in decided_on_photos(inherited)}
        Decisions(tuple(made.values())).check_choices(settings, "the coarse run")
    for name, effect in EFFECTS.items():
        if name not in made:
            made[name] = settle(name, effect.measure(scene), getattr(settings, name))
    return Decisions(tuple(made[name] for name in EFFECTS))


def decide_again(decisions: Decisions, name: str, scene: Scene) -> Decisions:
    """Decides anew about one effect, now that more of the scene is known; not where the command line set it."""
    choice = decisions[name].choice
    return decisions if choice != "auto" else decisions.replaced(settle(name, EFFECTS[name].measure(scene), choice))


def decided_on_photos(decisions: Decisions) -> Dict[str, bool]:
    """Whether effects are on that photos alone decide: a coarse run and a stylised run of it must agree on these."""
    return {item.name: item.on for item in decisions.items if EFFECTS[item.name].source == "photos"}


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


def _decide_layouts(scene: Scene, settings: EffectSettings) -> Dict[str, Decision]:
    """The layouts of space: on is the one that is asked for, else the first in the table that the scene needs."""
    found = {effect.name: effect.measure(scene) for effect in LAYOUTS}
    choices: Dict[str, EffectChoice] = {name: getattr(settings, name) for name in found}
    asked = [name for name, choice in choices.items() if choice == "on"]
    if len(asked) > 1:
        raise InputError(f"--pipeline.effects has {' and '.join(asked)} on, but space has one layout; name only one.")
    fitting = [name for name, each in found.items() if choices[name] == "auto" and each.on and each.possible]
    if not asked and not fitting:
        raise InputError(
            "--pipeline.effects turns off every layout of space that this scene needs; turn one on: "
            + ", ".join(name for name, each in found.items() if each.possible)
            + "."
        )
    chosen = (asked or fitting)[0]
    made = {chosen: settle(chosen, found[chosen], choices[chosen])}
    for name in found.keys() - made.keys():
        reason = f"space is laid out by {chosen}" if found[name].on else found[name].reason
        made[name] = _decision(name, found[name], choices[name], False, reason)
    return made


def _decision(name: str, found: Measurement, choice: EffectChoice, on: bool, reason: Optional[str] = None) -> Decision:
    return Decision(name, on, found.value, found.threshold, reason or found.reason, choice, found.parameters)
