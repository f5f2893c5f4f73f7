import base64
import csv
import io
import json
import math
import re

import pytest

from sparsestyle_ns.studies.advice import recommendation, rounded_duration, setting_line
from sparsestyle_ns.studies.curves import Curve, root_mean_square
from sparsestyle_ns.studies.tradeoff_report import Report
from sparsestyle_ns.utils.errors import InputError


def quadrature_curve(errors=(0.1, 0.02, 0.004), preset="32", own_error=0.1):
    curve = Curve(
        *("quadrature", "samples", "Samples a ray", "--pipeline.model.num-eval-samples", preset),
        *("view_seconds", "rmse", [("view_seconds", "rmse")]),
        own_error=own_error,
    )
    for number, error in zip((16, 32, 64), errors, strict=True):
        for seconds in (0.1, 0.12, 0.11):
            curve.add(number, {"view_seconds": seconds * number, "rmse": error}, busy=False)
    return curve


def training_curve():
    curve = Curve(
        *("training", "stage-1 iterations", "Iterations of stage 1", "--max-num-iterations", "2500"),
        *("train_seconds", "psnr", [("train_seconds", "psnr"), ("train_seconds", "ssim")]),
    )
    for iterations, seconds, psnr in ((100, 10.0, 17.0), (400, 40.0, 19.1), (800, 80.0, 19.6), (1600, 160.0, 20.1)):
        curve.add(iterations, {"train_seconds": seconds, "psnr": psnr, "ssim": 0.5}, busy=iterations == 800)
    return curve


def width_curve(narrow=19.0, preset=18.0):
    curve = Curve(
        *("training", "width", "Width", "--pipeline.model.coarse-field.layer-width", "256"),
        *("train_seconds", "psnr", [("train_seconds", "psnr")]),
    )
    for setting, end in (("256", preset), ("128", narrow)):
        for moment, seconds, loss in (("stop 1", 5.0, 2.0), ("stop 2", 20.0, 0.0)):
            curve.add(setting, {"train_seconds": seconds, "psnr": end - loss}, False, moment)
    return curve


def rendering_curve():
    curve = Curve(
        *("rendering", "baking", "Exact and baked", "--pipeline.model.bake-resolution", "exact"),
        *("view_seconds", "rmse", [("fps", "psnr")]),
    )
    curve.add("exact", {"view_seconds": 2.0, "fps": 0.5, "rmse": 0.0, "psnr": math.inf}, False)
    curve.add(256, {"view_seconds": 0.1, "fps": 10.0, "rmse": 0.02, "psnr": 34.0}, False)
    return curve


def make_report(*axes, **more):
    return Report("fern, 3 photos, 126 × 94", {"device": "a <CPU>", "versions": {"torch": "2"}}, list(axes), **more)


# ------------------------------------------------------------------------------------------------------------- a curve


def test_repetitions_give_median_and_spread():
    spread = quadrature_curve().find(32).spread("view_seconds")
    assert (spread.low, spread.median, spread.high, spread.count) == pytest.approx((3.2, 3.52, 3.84, 3))


def test_an_error_that_only_saves_time_may_cost_a_tenth_of_a_decibel():
    # The field has 20 dB. 0.02 costs 0.17 dB, 0.004 next to nothing.
    assert quadrature_curve().recommended.setting == "64"
    assert quadrature_curve(errors=(0.1, 0.015, 0.004)).recommended.setting == "32"
    assert "20.0 dB" in quadrature_curve().rule


def test_what_all_settings_cost_alike_is_no_reason_to_take_the_slowest():
    # All cost more than a tenth of a decibel, and the last two within a tenth of each other.
    assert quadrature_curve(errors=(0.1, 0.041, 0.04)).recommended.setting == "32"
    assert quadrature_curve(errors=(0.1, 0.06, 0.04)).recommended.setting == "64"


def test_a_run_is_recommended_up_to_where_time_no_longer_pays():
    # 2.1 dB for two doublings is worth it, 0.5 dB for one isn't: 0.75 would be.
    assert training_curve().recommended.setting == "400"


def test_a_point_measured_on_a_busy_machine_stays_marked():
    curve = quadrature_curve()
    curve.add(16, {"view_seconds": 9.0, "rmse": 0.1}, busy=True)
    curve.add(16, {"view_seconds": 1.6, "rmse": 0.1}, busy=False)
    assert [point.busy for point in curve.points] == [True, False, False]


# --------------------------------------------------------------------------------------------------------------- words


def test_the_recommendation_is_derived_from_the_measurements():
    line, *_ = recommendation([training_curve()])
    assert line.startswith(
        "Iterations of stage 1 (--max-num-iterations): 400 for a draft (40 s, 19.1 dB), "
        "1600 for the best result (2:40 min, 20.1 dB); after that 1 dB more takes 4× the time"
    )
    assert "measured once" in line


def test_a_preset_that_is_recommended_is_kept():
    line = setting_line(quadrature_curve(preset="64"))
    assert line.startswith("Samples a ray (--pipeline.model.num-eval-samples): keep 64")
    assert "32 would be 2× as fast" in line


def test_a_better_setting_is_named_with_what_it_changes():
    line = setting_line(quadrature_curve(errors=(0.1, 0.015, 0.004), preset="64"))
    assert "32 instead of 64: 2× as fast, costs 0.097 dB against photos instead of 0.0069" in line


def test_errors_and_the_observed_order_are_said():
    curve = quadrature_curve()
    curve.order = 1.46
    (line,) = recommendation([curve])
    assert line.endswith(" Errors: 0.1 with 16, 0.02 with 32, 0.004 with 64. Observed order of convergence: 1.5.")


def test_a_setting_that_is_hardly_faster_is_no_reason_to_change():
    curve = quadrature_curve(errors=(0.001, 0.001, 0.001), preset="32")
    curve.points[0].values["view_seconds"] = [3.5]  # 16 samples take as long as 32, but for a hair
    assert curve.recommended.setting == "16"
    assert "keep 32; 16 would be no better: " in setting_line(curve)


def test_of_runs_the_ends_are_compared():
    assert "128 instead of 256: 19.00 dB instead of 18.00" in setting_line(width_curve())
    assert "keep 256" in setting_line(width_curve(narrow=17.0))


def test_a_busy_machine_is_named():
    curve = quadrature_curve(preset="64")
    curve.find(64).busy = True
    assert setting_line(curve).endswith("[the machine was busy]")


@pytest.mark.parametrize(("seconds", "words"), [(0.354, "0.35 s"), (40.2, "40 s"), (185.0, "3:05 min")])
def test_durations_in_words(seconds, words):
    assert rounded_duration(seconds) == words


# --------------------------------------------------------------------------------------------------------------- files


def test_the_json_report_has_all_axes_with_front_and_recommended_point(tmp_path):
    curve = quadrature_curve(errors=(0.1, 0.2, 0.004))
    curve.order = 1.5
    make_report(curve, training_curve(), left_out=["Style: no painting"]).write(tmp_path)
    content = json.loads((tmp_path / "tradeoff.json").read_text())
    assert [curve["name"] for curve in content["axes"]] == ["stage-1 iterations", "samples"]
    samples = content["axes"][1]
    assert samples["flag"] == "--pipeline.model.num-eval-samples"
    assert samples["observed_order"] == 1.5
    assert [point["on_front"] for point in samples["points"]] == [True, False, True]
    assert [point["recommended"] for point in samples["points"]] == [False, False, True]
    assert samples["points"][0]["values"]["view_seconds"]["count"] == 3
    assert [point["busy"] for point in content["axes"][0]["points"]] == [False, False, True, False]
    assert content["left_out"] == ["Style: no painting"]
    assert content["recommendation"]


def test_json_has_no_infinity(tmp_path):
    make_report(rendering_curve()).write(tmp_path)

    def refuse(word):
        raise AssertionError(word)

    content = json.loads((tmp_path / "tradeoff.json").read_text(), parse_constant=refuse)
    assert content["axes"][0]["points"][0]["values"]["psnr"]["median"] is None


def test_the_csv_has_a_row_for_each_figure(tmp_path):
    make_report(quadrature_curve()).write(tmp_path)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "tradeoff.csv").read_text())))
    assert len(rows) == 3 * 2
    assert {row["setting"] for row in rows if row["recommended"] == "1"} == {"64"}
    assert float(rows[0]["median"]) == pytest.approx(1.76)


def test_the_page_needs_nothing_else_and_trusts_no_name(tmp_path):
    path = make_report(quadrature_curve(), width_curve(), rendering_curve(), training_curve()).write(tmp_path)
    page = path.read_text()
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(source.startswith("data:") for source in sources)
    plots = [base64.b64decode(source.split(",")[1]) for source in sources if "svg" in source]
    assert len(plots) == 1 + 1 + 1 + 2
    assert all(b"<svg" in plot for plot in plots)
    assert "a &lt;CPU&gt;" in page
    assert "400 for a draft (40 s, 19.1 dB)" in page
    assert page.index("In short") < page.index("Quadrature")
    assert (tmp_path / "tradeoff.png").read_bytes().startswith(b"\x89PNG")


def test_a_report_without_a_single_figure_is_written_too(tmp_path):
    page = make_report(left_out=["Stopped by Ctrl-C"]).write(tmp_path)
    assert "Stopped by Ctrl-C" in page.read_text()
    assert json.loads((tmp_path / "tradeoff.json").read_text())["axes"] == []


def test_a_folder_that_can_not_be_written_to_is_said_in_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"can't be written to .*file.*; name another --output-dir"):
        make_report().write(tmp_path / "file")


def test_psnr_stands_for_the_error_that_has_it():
    curve = width_curve()
    assert curve.error_of(curve.points[-1]) == pytest.approx(root_mean_square(19.0))
