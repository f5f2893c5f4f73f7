"""What is decided about made scenes and real ones, and what follows from settings."""

import dataclasses
import json
import os
from pathlib import Path

import pytest
import torch
from conftest import decided
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sparsestyle_ns.cli import main
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.data.scene_info import select_outputs
from sparsestyle_ns.effects.decisions import Decisions, EffectSettings
from sparsestyle_ns.effects.registry import EFFECTS, decide, decide_again, decided_on_photos
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.utils.errors import InputError

DATA = Path(os.environ.get("SPARSESTYLE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
PARSERS = {"llff": LLFFDataParserConfig, "blender": BlenderDataParserConfig, "nerfstudio": NerfstudioDataParserConfig}


def training_views(folder: Path, layout: str = "llff") -> Scene:
    """All training views of a scene."""
    return Scene(read_scene(PARSERS[layout](data=folder).setup()))


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory):
    """Makes a scene by data_scripts/make_sample_scene.py, once for the same options."""
    import make_sample_scene

    scenes = {}

    def make(layout: str, *options: str) -> Scene:
        if (layout, options) not in scenes:
            folder = tmp_path_factory.mktemp("made")
            make_sample_scene.main([str(folder), "--layout", layout, "--supersample", "1", *options])
            scenes[layout, options] = training_views(folder / layout, layout)
        return scenes[layout, options]

    return make


SEEN = ("--width", "200", "--num-views", "9")
"""Photos large enough to match points: one is held out, eight are trained on."""
RING = ("--width", "48", "--num-views", "10")
OBJECT = ("--width", "32", "--num-train", "8", "--num-val", "1", "--num-test", "1")


@pytest.mark.parametrize(
    "name, calling, other",
    [
        ("ndc", ("llff", *SEEN), ("nerfstudio", *RING)),
        ("box", ("blender", *OBJECT), ("nerfstudio", *RING)),
        ("contraction", ("nerfstudio", *RING), ("blender", *OBJECT)),
        ("background", ("blender", *OBJECT), ("llff", *SEEN)),
        ("view_color", ("llff", *SEEN, "--shiny", "0.8"), ("llff", *SEEN)),
        ("exposure", ("llff", *SEEN, "--exposure", "0.5"), ("llff", *SEEN)),
        ("lens_distortion", ("nerfstudio", *RING, "--distortion", "0.1"), ("nerfstudio", *RING)),
        ("matched_depth", ("llff", *SEEN), ("blender", *OBJECT)),
    ],
)
def test_auto_turns_an_effect_on_for_the_scene_that_calls_for_it_and_off_for_another(made, name, calling, other):
    on, off = (decide(made(*scene), EffectSettings())[name] for scene in (calling, other))
    assert (on.on, off.on) == (True, False)
    for decision in (on, off):
        assert decision.reason and decision.choice == "auto"
    if on.measured is not None and off.measured is not None:
        assert on.measured != off.measured


def test_shine_is_not_taken_for_exposure_nor_exposure_for_shine(made):
    assert not decide(made("llff", *SEEN, "--shiny", "0.8"), EffectSettings()).on("exposure")
    assert not decide(made("llff", *SEEN, "--exposure", "0.5"), EffectSettings()).on("view_color")


def test_exposures_are_measured_as_they_were_made(made):
    import numpy as np
    from sample_scene.writers import photo_gains

    from sparsestyle_ns.effects.matched_colors import fit_gains

    gains, _ = fit_gains(made("llff", *SEEN, "--exposure", "0.5").matches)
    expected = np.log(photo_gains(9, 0.5, [0, 8]))[[1, 2, 3, 4, 5, 6, 7]]
    # Photos are cut off at white, and bytes: a tenth of a stop is 0.07.
    assert np.abs(gains - expected).max() < 0.07
    assert np.abs(gains.mean(axis=0)).max() < 1e-6


def test_few_photos_are_not_enough_to_tell_shine_from_shape(made):
    scene = made("llff", *SEEN, "--shiny", "0.8")
    few = dataclasses.replace(scene, outputs=select_outputs(scene.outputs, (0, 1, 2)))
    decision = decide(few, EffectSettings())["view_color"]
    assert not decision.on


def test_photos_in_which_no_points_match_have_no_measured_exposure(made):
    decision = decide(made("blender", *OBJECT), EffectSettings())["exposure"]
    assert (decision.on, decision.measured) == (False, None)
    assert "not measurable" in decision.reason


@pytest.mark.skipif(not (DATA / "llff" / "fern").is_dir(), reason=f"{DATA} has no llff/fern; set SPARSESTYLE_DATA")
def test_fern_is_simulated_in_ndc_without_background_shine_and_exposure(capsys):
    main(["effects", "llff-data", "--data", str(DATA / "llff" / "fern"), "--json"])
    effects = json.loads(capsys.readouterr().out)["effects"]
    assert [effect["name"] for effect in effects if effect["on"]] == [
        "ndc",
        "matched_depth",
        "empty_space",
        "residual_density",
        "palette",
    ]
    assert all({"name", "on", "measured", "threshold", "reason"} <= effect.keys() for effect in effects)


@pytest.mark.skipif(
    not (DATA / "blender" / "lego").is_dir(), reason=f"{DATA} has no blender/lego; set SPARSESTYLE_DATA"
)
def test_lego_is_simulated_in_a_box_before_white(capsys):
    main(["effects", "blender-data", "--data", str(DATA / "blender" / "lego"), "--json"])
    effects = {effect["name"]: effect for effect in json.loads(capsys.readouterr().out)["effects"]}
    on = {name for name, effect in effects.items() if effect["on"]}
    assert on == {"box", "background", "empty_space", "residual_density", "palette"}
    assert effects["background"]["parameters"] == {"color": [1.0, 1.0, 1.0]}


def fog(density: float):
    return lambda points: torch.full((len(points),), density)


def ball(points):
    """A hard ball of radius 0.7, a fifth of the cube."""
    return torch.where(points.norm(dim=-1) < 0.7, 1e4, 0.0)


def haze(points):
    """A tenth of the cube, half transparent over a cell."""
    return torch.where(points.norm(dim=-1) < 0.6, 10.0, 0.0)


THIN = fog(0.9)
"""Each cell lets 97% of the light through, the whole cube 16%."""


@pytest.mark.parametrize(
    "density, skips, hazy",
    [(fog(5.0), False, True), (THIN, False, True), (fog(0.05), True, False), (ball, True, False), (haze, True, True)],
)
def test_the_coarse_field_decides_about_empty_space_and_residual_density(made, density, skips, hazy):
    scene = dataclasses.replace(made("blender", *OBJECT), coarse_density=density)
    decisions = decide(scene, EffectSettings())
    assert (decisions.on("empty_space"), decisions.on("residual_density")) == (skips, hazy)
    assert decisions["empty_space"].measured is not None


def test_before_there_is_a_coarse_field_and_a_painting_the_papers_form_is_assumed(made):
    decisions = decide(made("blender", *OBJECT), EffectSettings())
    for name in ("empty_space", "residual_density", "palette"):
        assert decisions[name].on and decisions[name].measured is None


def test_a_painting_in_the_photos_own_colours_needs_no_palette_transfer(made):
    scene = made("blender", *OBJECT)
    photo = torch.from_numpy(scene.photos[0])
    own = photo[photo[..., 3] > 0.5][:, :3].T[:, None]
    every = torch.cat([torch.from_numpy(each)[each[..., 3] > 0.5][:, :3] for each in scene.photos]).T[:, None]
    for painting, on in ((every, False), (1.0 - own, True)):
        assert decide(dataclasses.replace(scene, style_image=painting), EffectSettings()).on("palette") == on


def test_a_setting_overrules_what_was_measured_and_the_reason_says_so(made):
    scene = made("blender", *OBJECT)
    decisions = decide(scene, EffectSettings(background="off", exposure="on", residual_density="off"))
    assert not decisions.on("background") and decisions.on("exposure") and not decisions.on("residual_density")
    assert decisions["exposure"].choice == "on" and decisions["exposure"].reason.startswith("asked for")


def test_space_has_exactly_one_layout(made):
    scene = made("blender", *OBJECT)
    layouts = ("ndc", "box", "contraction")
    for settings, expected in (
        (EffectSettings(), "box"),
        (EffectSettings(box="off"), "contraction"),
        (EffectSettings(contraction="on"), "contraction"),
    ):
        decisions = decide(scene, settings)
        assert [name for name in layouts if decisions.on(name)] == [expected]
    with pytest.raises(InputError, match="box and contraction on"):
        decide(scene, EffectSettings(box="on", contraction="on"))
    with pytest.raises(InputError, match="turn one on: box, contraction"):
        decide(scene, EffectSettings(box="off", contraction="off"))


@pytest.mark.parametrize("name, reason", [("ndc", "no bounds of depth"), ("lens_distortion", "no distortion")])
def test_what_a_scene_cant_have_is_refused(made, name, reason):
    with pytest.raises(InputError, match=reason):
        decide(made("blender", *OBJECT), EffectSettings(**{name: "on"}))


def test_a_stylised_run_takes_over_what_photos_decided_and_refuses_to_decide_otherwise(made):
    scene, coarse = made("blender", *OBJECT), decided("box", "background", "exposure", "empty_space")
    decisions = decide(scene, EffectSettings(), coarse)
    assert decided_on_photos(decisions) == decided_on_photos(coarse)
    assert decisions.on("residual_density")
    with pytest.raises(InputError, match=r"exposure is off, but the coarse run has it on"):
        decide(scene, EffectSettings(exposure="off"), coarse)


def test_a_decision_is_made_again_only_where_nobody_asked_for_it(made):
    scene = dataclasses.replace(made("blender", *OBJECT), coarse_density=fog(5.0))
    auto, asked = decided("box", "empty_space"), decide(scene, EffectSettings(empty_space="on"))
    assert not decide_again(auto, "empty_space", scene).on("empty_space")
    assert decide_again(asked, "empty_space", scene) is asked


def test_decisions_survive_being_written_down(made):
    decisions = decide(made("blender", *OBJECT), EffectSettings(exposure="on"))
    assert Decisions.from_records(json.loads(decisions.json())["effects"]) == decisions


def test_the_table_has_a_line_for_every_effect_in_order(made):
    decisions = decide(made("blender", *OBJECT), EffectSettings())
    lines = decisions.text().splitlines()
    assert [line.split()[0] for line in lines] == ["effect", *EFFECTS]


def test_the_settings_are_the_effects_in_order():
    assert [field.name for field in dataclasses.fields(EffectSettings)] == list(EFFECTS)


def test_the_command_takes_a_dataparsers_options_and_hands_them_on(llff_scene, capsys):
    main(["effects", "--data", str(llff_scene), "--", "llff-data", "--eval-interval", "4"])
    printed = capsys.readouterr().out
    assert printed.splitlines()[1].startswith("ndc")
    assert printed.splitlines()[-1].endswith(f"--data {llff_scene} llff-data --eval-interval 4")


def test_an_unknown_dataparser_and_a_missing_folder_are_named(tmp_path):
    for arguments, word in ((["no-data"], "no-data"), (["llff-data"], "nowhere")):
        with pytest.raises(SystemExit, match=word):
            main(["effects", *arguments, "--data", str(tmp_path / "nowhere")])
