"""ArtFID: its distance against SciPy, its pictures and its network, and reports with and without its weights."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Dict

import pytest
import torch
from reference import frechet_distance as slow_frechet_distance
from torchvision.models import alexnet, inception_v3

from sparsestyle_ns.cli import main
from sparsestyle_ns.evaluation.held_out import PathFrames
from sparsestyle_ns.evaluation.tables import report_tables
from sparsestyle_ns.metrics import art_fid
from sparsestyle_ns.metrics.art_fid import (
    ART_INCEPTION_FILE,
    ArtFID,
    frechet_distance,
    load_art_inception,
    missing_weights,
    resized,
    squares,
    why_left_out,
)
from sparsestyle_ns.metrics.image import ALEXNET_FILE, lpips_metric
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig
from sparsestyle_ns.studies.paper_studies import style_table
from sparsestyle_ns.studies.run_figures import PaintingMeasure, RunFigures, read_figures
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError


def sample(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_the_distance_is_that_of_scipys_matrix_square_root() -> None:
    mixing = sample(6, 6, seed=2)
    first, second = sample(40, 6), 0.5 + sample(30, 6, seed=1) @ mixing
    assert frechet_distance(first, second) == pytest.approx(slow_frechet_distance(first, second), rel=1e-9)
    assert frechet_distance(second, first) == pytest.approx(slow_frechet_distance(first, second), rel=1e-9)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_a_shift_of_the_mean_gives_its_squared_length(count: int) -> None:
    first, shift = sample(count, 10), torch.arange(10.0)
    assert frechet_distance(first, first + shift) == pytest.approx(285.0, rel=1e-9)
    assert frechet_distance(first, first[torch.randperm(count)]) == pytest.approx(0.0, abs=1e-12)


def test_few_vectors_in_many_dimensions_have_the_distance_that_they_have_in_their_own() -> None:
    axes = torch.linalg.qr(sample(500, 6, seed=3)).Q
    first, second = sample(40, 6), 2.0 * sample(30, 6, seed=1)
    expected = slow_frechet_distance(first, second)
    assert frechet_distance(first @ axes.T, second @ axes.T) == pytest.approx(expected, rel=1e-9)
    assert frechet_distance((first @ axes.T).float(), (second @ axes.T).float()) == pytest.approx(expected, rel=1e-5)


def test_a_single_vector_has_no_spread() -> None:
    first = torch.tensor([[-3.0, 0.0], [3.0, 0.0]])
    assert frechet_distance(first, torch.tensor([[0.0, 4.0]])) == pytest.approx(16.0 + 18.0)
    # Along one axis it is the difference of the deviations, √18 and √2.
    other = torch.tensor([[-1.0, 4.0], [1.0, 4.0]])
    assert frechet_distance(first, other) == pytest.approx(16.0 + (math.sqrt(18.0) - math.sqrt(2.0)) ** 2)


@pytest.mark.parametrize("size", [(94, 126), (600, 448), (448, 448), (30, 300)])
def test_squares_cover_a_picture_from_border_to_border(size: tuple) -> None:
    rows, columns = torch.meshgrid(torch.linspace(0, 1, size[0]), torch.linspace(0, 1, size[1]), indexing="ij")
    picture = resized(torch.stack([rows, columns, 0 * rows], dim=-1))
    assert min(picture.shape[2:]) == art_fid.SHORTER_SIDE
    assert max(picture.shape[2:]) == pytest.approx(art_fid.SHORTER_SIDE * max(size) / min(size), abs=0.5)
    cut = squares(picture)
    assert cut.shape[1:] == (3, art_fid.SQUARE, art_fid.SQUARE) and len(cut) % 3 == 0
    assert torch.equal(cut[0], picture[0, :, : art_fid.SQUARE, : art_fid.SQUARE])
    assert torch.equal(cut[-1], picture[0, :, -art_fid.SQUARE :, -art_fid.SQUARE :])
    starts = cut[:, 1, 0, 0].unique()  # of the columns, of which the last counts as 1
    assert (starts.diff() * picture.shape[3] <= art_fid.STEP + 2).all()


@pytest.fixture(scope="module")
def published() -> Dict[str, torch.Tensor]:
    """Random weights in the layout of the file that ArtFID's authors publish."""
    torch.manual_seed(0)
    network = inception_v3(weights=None, aux_logits=True, init_weights=False)
    state = {name: value for name, value in network.state_dict().items() if not name.startswith(("fc.", "Aux"))}
    for name, value in network.state_dict().items():
        for head in (1, 2):
            if name.startswith(("fc.", "AuxLogits.")):
                state[name.replace("fc.", f"fc{head}.", 1) if name[0] == "f" else f"AuxLogits{head}{name[9:]}"] = value
    return state


@pytest.fixture(scope="module")
def torch_home(published: Dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A torch hub folder that has both files, with random weights."""
    folder = tmp_path_factory.mktemp("hub") / "checkpoints"
    folder.mkdir()
    torch.save(published, folder / ART_INCEPTION_FILE)
    torch.manual_seed(1)
    state = alexnet(weights=None).state_dict()
    for name, value in state.items():
        if name.startswith("classifier"):  # LPIPS doesn't use it, and it is most of the file
            state[name] = torch.zeros(1).expand(value.shape)
    torch.save(state, folder / ALEXNET_FILE)
    return folder.parent


@pytest.fixture
def with_weights(torch_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Has the weights in the torch hub cache, and small squares, which take less time."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(torch_home))
    monkeypatch.setattr(art_fid, "SQUARE", 75)
    monkeypatch.setattr(art_fid, "SHORTER_SIDE", 90)


def test_features_are_the_pooled_ones_of_pictures_as_they_are(published: Dict, tmp_path: Path) -> None:
    torch.save(published, tmp_path / "file.pth")
    before = torch.random.get_rng_state()
    network = load_art_inception(tmp_path / "file.pth")
    assert torch.equal(torch.random.get_rng_state(), before)
    pictures = torch.rand(2, 3, 80, 75)
    whole = inception_v3(weights=None, aux_logits=False, init_weights=False)
    whole.load_state_dict(
        {name: value for name, value in published.items() if name in whole.state_dict()}, strict=False
    )
    seen = []
    whole.avgpool.register_forward_hook(lambda module, given, pooled: seen.append(pooled))
    with torch.no_grad():
        whole.eval()(pictures)
        torch.testing.assert_close(network(pictures), seen[0].flatten(1))
    assert not any(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda state: state.pop("Mixed_6e.branch_pool.bn.running_var"), "Mixed_6e.branch_pool.bn.running_var is miss"),
        (lambda state: state.update({"fc.weight": torch.zeros(1000, 2048)}), "fc.weight belongs to another network"),
        (lambda state: state.update({"Conv2d_1a_3x3.conv.weight": torch.zeros(32, 3, 5, 5)}), "has the shape"),
        (lambda state: state.update({"Conv2d_1a_3x3.bn.bias": torch.full((32,), torch.nan)}), "not finite"),
    ],
)
def test_weights_of_another_network_are_refused_in_a_sentence(
    change, reason: str, published: Dict, tmp_path: Path
) -> None:
    state = dict(published)
    change(state)
    torch.save(state, tmp_path / "file.pth")
    with pytest.raises(InputError, match=reason) as caught:
        load_art_inception(tmp_path / "file.pth")
    assert str(tmp_path / "file.pth") in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"not found"])
def test_a_damaged_file_is_refused_in_a_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "file.pth").write_bytes(content)
    with pytest.raises(InputError, match=r"file\.pth is not the Inception-v3 of ArtFID's authors"):
        load_art_inception(tmp_path / "file.pth")


def test_the_figure_is_of_all_pictures_and_one_plus_lpips_times_one_plus_fid(with_weights: None) -> None:
    painting, first, second, content = (torch.rand(40, 50, 3) for _ in range(4))
    measured = ArtFID.against(painting.permute(2, 0, 1))
    for picture in (first, second):
        measured.add(picture, content)
    metric, network = lpips_metric((90, 90)), measured.network
    distances = [float(metric(resized(picture), resized(content))) for picture in (first, second)]
    with torch.no_grad():
        style, *stylised = (network(squares(resized(picture))) for picture in (painting, first, second))
    expected = (1 + sum(distances) / 2) * (1 + frechet_distance(torch.cat(stylised), style))
    assert measured.figures() == {"art_fid": pytest.approx(expected, rel=1e-5)}
    assert expected > 1
    itself = ArtFID.against(painting.permute(2, 0, 1))
    itself.add(painting, painting)
    assert itself.figures() == {"art_fid": pytest.approx(1.0, abs=1e-5)}


def test_evaluate_reports_it_where_its_weights_are(
    with_weights: None, runs: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    main(["evaluate", str(runs.style), "--output-path", str(tmp_path / "report.json")])
    means = json.loads((tmp_path / "report.json").read_text())["results"]
    assert means["art_fid"] > 1
    assert "lpips" not in means  # of pictures of 32 × 24 pixels nothing is left in its last layers
    printed = capsys.readouterr().out
    assert "ArtFID ↓" in printed and "left out" not in printed


def test_without_its_weights_it_is_left_out_and_the_files_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: pytest.fail("the network was asked"))
    assert ArtFID.against(torch.rand(3, 40, 50)) is None
    sentence = f"ArtFID is left out: it needs {ART_INCEPTION_FILE} and {ALEXNET_FILE} in {tmp_path / 'checkpoints'}."
    assert why_left_out({}) == sentence
    assert report_tables({"coarse_psnr": 20.0, "style_loss": 0.1}, 3)[2].note == sentence
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / ALEXNET_FILE).touch()
    assert missing_weights() == [ART_INCEPTION_FILE]
    assert why_left_out({"art_fid": 2.0}) == ""


def test_a_row_of_a_study_has_it_for_every_fourth_frame(with_weights: None, painting: Path) -> None:
    stylised, coarse = ([torch.rand(40, 50, 3) for _ in range(5)] for _ in range(2))
    frames = PathFrames(stylised, coarse, [SimpleNamespace(covered=torch.ones(40, 50, dtype=torch.bool))] * 5)
    figures = PaintingMeasure(painting).figures(frames, HierStylePipelineConfig(feature_side=48))
    expected = ArtFID.against(Painting.read(painting).pixels)
    for index in (0, 4):
        expected.add(stylised[index], coarse[index])
    assert figures["art_fid"] == pytest.approx(expected.figures()["art_fid"])
    ours = {**figures, "style_loss_before": 0.1, "gram_distance_before": 0.1}
    table = style_table({"ours": RunFigures(ours, [])})
    assert "ArtFID ↓" in table.columns and table.note == ""


def test_rows_of_a_study_are_measured_again_once_there_are_weights(
    torch_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def known(figures: Dict[str, float]) -> bool:
        (tmp_path / "figures.json").write_text(json.dumps({"step": 7, "figures": figures}))
        return read_figures(tmp_path, 7) is not None

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert known({"style_loss": 0.1}) and known({"style_loss": 0.1, "art_fid": 2.0})
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(torch_home))
    both = {"art_fid": 2.0, "short_lpips": 0.1}
    assert known({"style_loss": 0.1, **both})
    for missing in ((), ("art_fid",), ("short_lpips",)):
        figures = {key: value for key, value in both.items() if key not in missing}
        assert known(figures) == (not missing)
    assert not known({"style_loss": 0.1})
