"""All effects, in the order of the table, and the one place that decides about them."""

from typing import Callable, Dict, Literal, NamedTuple, Optional

from sparsestyle_ns.effects.background import measure_background
from sparsestyle_ns.effects.coarse_geometry import measure_empty_space, measure_residual_density
from sparsestyle_ns.effects.decisions import Decision, Decisions, EffectChoice, EffectSettings, Measurement
from sparsestyle_ns.effects.layouts import measure_box, measure_contraction, measure_forward_facing
from sparsestyle_ns.effects.lens_distortion import measure_lens_distortion
from sparsestyle_ns.effects.matched_colors import measure_exposure, measure_view_color
from sparsestyle_ns.effects.matched_depth import measure_matched_depth
from sparsestyle_ns.effects.palette import measure_palette
from sparsestyle_ns.effects.pose_refinement import measure_pose_refinement
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.utils.errors import InputError


class Effect(NamedTuple):
    """How a scene is measured for an effect. Those of the photos are decided before stage 1, and stage 2 keeps them."""

    measure: Callable[[Scene], Measurement]
    source: Literal["photos", "coarse field", "style image"] = "photos"


EFFECTS: Dict[str, Effect] = {
    "ndc": Effect(measure_forward_facing),
    "box": Effect(measure_box),
    "contraction": Effect(measure_contraction),
    "background": Effect(measure_background),
    "view_color": Effect(measure_view_color),
    "exposure": Effect(measure_exposure),
    "lens_distortion": Effect(measure_lens_distortion),
    "matched_depth": Effect(measure_matched_depth),
    "pose_refinement": Effect(measure_pose_refinement),
    "empty_space": Effect(measure_empty_space, source="coarse field"),
    "residual_density": Effect(measure_residual_density, source="coarse field"),
    "palette": Effect(measure_palette, source="style image"),
}
"""By the name on the command line, `--pipeline.effects.NAME`."""
LAYOUTS = ("ndc", "box", "contraction")
"""Ways to lay out space, of which exactly one is on."""


def decide(scene: Scene, settings: EffectSettings, inherited: Optional[Decisions] = None) -> Decisions:
    """Decides about all effects.

    Args:
        inherited: the decisions of the coarse run that a stylised run builds on. Those on photos are taken over.

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
            made[name] = _settle(name, effect.measure(scene), getattr(settings, name))
    return Decisions(tuple(made[name] for name in EFFECTS))


def decide_again(decisions: Decisions, name: str, scene: Scene) -> Decisions:
    """Decides anew about one effect, now that more of the scene is known; not where the command line set it."""
    choice = decisions[name].choice
    return decisions if choice != "auto" else decisions.replaced(_settle(name, EFFECTS[name].measure(scene), choice))


def decided_on_photos(decisions: Decisions) -> Dict[str, bool]:
    """Whether effects are on that photos alone decide: a coarse run and a stylised run of it must agree on these."""
    return {item.name: item.on for item in decisions.items if EFFECTS[item.name].source == "photos"}


def _settle(name: str, found: Measurement, choice: EffectChoice) -> Decision:
    """The decision about one effect that depends on no other."""
    if choice == "auto":
        return _decision(name, found, choice, found.on and found.possible)
    if choice == "on" and not found.possible:
        raise InputError(f"--pipeline.effects.{name} can't be on: {found.reason}; leave it out.")
    return _decision(name, found, choice, choice == "on", f"asked for ({found.reason})")


def _decide_layouts(scene: Scene, settings: EffectSettings) -> Dict[str, Decision]:
    """The layouts of space: on is the one that is asked for, else the first in the table that the scene needs."""
    found = {name: EFFECTS[name].measure(scene) for name in LAYOUTS}
    choices: Dict[str, EffectChoice] = {name: getattr(settings, name) for name in found}
    asked = [name for name, choice in choices.items() if choice == "on"]
    if len(asked) > 1:
        raise InputError(f"--pipeline.effects has {' and '.join(asked)} on, but space has one layout; name only one.")
    fitting = [name for name, each in found.items() if choices[name] == "auto" and each.on and each.possible]
    if not asked and not fitting:
        possible = ", ".join(name for name, each in found.items() if each.possible)
        raise InputError(
            f"--pipeline.effects turns off every layout of space that this scene needs; turn one on: {possible}."
        )
    chosen = (asked or fitting)[0]
    made = {chosen: _settle(chosen, found[chosen], choices[chosen])}
    for name in found.keys() - made.keys():
        reason = f"space is laid out by {chosen}" if found[name].on else found[name].reason
        made[name] = _decision(name, found[name], choices[name], False, reason)
    return made


def _decision(name: str, found: Measurement, choice: EffectChoice, on: bool, reason: Optional[str] = None) -> Decision:
    return Decision(name, on, found.value, found.threshold, reason or found.reason, choice, found.parameters)
