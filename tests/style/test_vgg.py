import hashlib
import importlib.machinery
import importlib.util
import io
import socket
import subprocess
import sys
from pathlib import Path
from urllib.error import URLError

import pytest
import torch

from sparsestyle_ns.losses.content import content_loss
from sparsestyle_ns.losses.nnfm import nnfm_loss
from sparsestyle_ns.style import vgg
from sparsestyle_ns.style.backbones import load_backbone
from sparsestyle_ns.utils.errors import InputError

IMAGENET_MEAN = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
IMAGENET_STD = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
CHANNELS = [(64, 3), (64, 64), (128, 64), (128, 128), (256, 128), (256, 256), (256, 256)]
PLAIN_KEYS = [f"features.{i}" for i in (0, 2, 5, 7, 10, 12, 14)]
SHIFT_TOLERANT_KEYS = [f"net.slice{k}.{i}" for k, i in [(1, 0), (1, 2), (2, 6), (2, 8), (3, 12), (3, 14), (3, 16)]]


def random_state(keys, seed=0):
    """Weights as He et al. initialise them, so that activations neither vanish nor explode."""
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for key, (fan_out, fan_in) in zip(keys, CHANNELS, strict=True):
        state[f"{key}.weight"] = torch.randn(fan_out, fan_in, 3, 3, generator=generator) * (2 / (9 * fan_in)) ** 0.5
        state[f"{key}.bias"] = 0.1 * torch.randn(fan_out, generator=generator)
    return state


def shift_tolerant_state():
    state = random_state(SHIFT_TOLERANT_KEYS)
    binomial = torch.tensor([1.0, 2.0, 1.0]) / 4
    for key, channels in [("net.slice2.5", 64), ("net.slice3.11", 128)]:
        state[f"{key}.filt"] = torch.outer(binomial, binomial).repeat(channels, 1, 1, 1)
    return state


@pytest.fixture(scope="module")
def plain_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "mine.pth"
    torch.save(random_state(PLAIN_KEYS), path)
    return path


@pytest.fixture(scope="module")
def shift_tolerant_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("shift_tolerant") / "mine.pth"
    torch.save(shift_tolerant_state(), path)
    return path


@pytest.fixture(autouse=True)
def hub(tmp_path, monkeypatch):
    """An empty torch hub cache on a machine without a network; the folder weights would be in."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))

    def no_network(*args, **kwargs):
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", no_network)
    return tmp_path / "torch" / "hub" / "checkpoints"


@pytest.fixture
def wheel(tmp_path, monkeypatch, shift_tolerant_file):
    """A package stlpips_pytorch that holds the weight file and nothing else."""
    path = tmp_path / "site" / "stlpips_pytorch" / "weights" / "vST0.0" / "vgg_shift_tolerant.pth"
    path.parent.mkdir(parents=True)
    path.write_bytes(shift_tolerant_file.read_bytes())
    spec = importlib.machinery.ModuleSpec("stlpips_pytorch", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path / "site" / "stlpips_pytorch")]
    find_only(spec, monkeypatch)
    return path


@pytest.fixture
def no_wheel(monkeypatch):
    find_only(None, monkeypatch)


def find_only(spec, monkeypatch):
    """Makes `spec` what Python finds of stlpips_pytorch, whether or not it is installed."""
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *args: spec if name == "stlpips_pytorch" else find_spec(name, *args)
    )


@pytest.fixture
def images():
    return torch.rand(2, 3, 37, 50, generator=torch.Generator().manual_seed(1))


def block_3(features, last, images):
    """The outputs of the three ReLUs before layer `last` of a peer's `features`, joined."""
    maps, outputs = (images - IMAGENET_MEAN) / IMAGENET_STD, []
    for layer in features[:last]:
        maps = layer(maps)
        outputs.append(maps.clone())
    return torch.cat(outputs[-5::2], dim=1)


# The two networks


def test_the_plain_network_is_torchvisions(plain_file, images):
    from torchvision.models import vgg as models

    peer = models.make_layers(models.cfgs["D"])
    state = {key.removeprefix("features."): value for key, value in torch.load(plain_file).items()}
    peer[:16].load_state_dict(state)
    features = load_backbone("vgg16", plain_file).double()(images.double())
    assert features.shape == (2, vgg.VGG16.channels, 9, 12)
    torch.testing.assert_close(features, block_3(peer.double(), 16, images.double()), rtol=0, atol=1e-10)


def test_the_shift_tolerant_network_is_that_of_its_own_package(images):
    from stlpips_pytorch.models_lpf import vgg as trunk

    path = Path(trunk.__file__).parents[1] / "weights" / "vST0.0" / "vgg_shift_tolerant.pth"
    peer = trunk.make_layers(trunk.cfg["D"], filter_size=3, pad_more=True)
    state = torch.load(path, map_location="cpu")
    state = {key.split(".", 2)[2]: value for key, value in state.items() if key.startswith("net.slice")}
    peer.load_state_dict(state, strict=False)
    backbone = load_backbone("vgg16-shift-tolerant")
    assert str(path) in backbone.description.source
    features = backbone.double()(images.double())
    assert features.shape == (2, vgg.VGG16.channels, 10, 14)
    torch.testing.assert_close(features, block_3(peer.double(), 18, images.double()), rtol=0, atol=1e-10)


@pytest.mark.parametrize("side", [8, 9, 31])
def test_small_images_have_features_of_the_promised_size(side, plain_file, shift_tolerant_file):
    image = torch.rand(1, 3, side, 40, generator=torch.Generator().manual_seed(2))
    assert load_backbone("auto", plain_file)(image).shape[2:] == (side // 2 // 2, 10)
    assert load_backbone("auto", shift_tolerant_file)(image).shape[2:] == ((side // 2 + 1) // 2 + 1, 11)


@pytest.mark.parametrize("file", ["plain_file", "shift_tolerant_file"])
def test_a_backbone_is_frozen_and_passes_exact_gradients_to_the_image(file, request):
    backbone = load_backbone("auto", request.getfixturevalue(file)).double()
    assert not backbone.training
    assert all(not parameter.requires_grad for parameter in backbone.parameters())
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(1, 3, 8, 8, generator=generator, dtype=torch.float64, requires_grad=True)
    direction = torch.randn(image.shape, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(backbone(image).square().mean(), image)
    # One direction stands for the 192 pixels; the step stays on one side of the kinks of ReLU and pooling.
    step = 1e-7 * direction
    with torch.no_grad():
        slope = (backbone(image + step).square().mean() - backbone(image - step).square().mean()) / 2e-7
    assert (gradient * direction).sum().item() == pytest.approx(slope.item(), rel=1e-5)
    assert all(parameter.grad is None for parameter in backbone.parameters())


def test_loading_leaves_the_random_state_alone(plain_file):
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    load_backbone("auto", plain_file)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("file", ["plain_file", "shift_tolerant_file"])
def test_features_on_cuda_are_those_on_the_cpu(file, images, request):
    backbone = load_backbone("auto", request.getfixturevalue(file))
    expected = backbone(images)
    # Convolutions on CUDA may round to TF32, which keeps three decimal digits.
    torch.testing.assert_close(backbone.cuda()(images.cuda()).cpu(), expected, rtol=1e-2, atol=1e-2)


def test_a_network_with_larger_activations_gives_the_same_losses(plain_file, images, tmp_path):
    scale = 30.0
    state = torch.load(plain_file)
    # ReLU and pooling are homogeneous: scaling the first weights and every bias scales all features.
    scaled = {key: scale * value if key.endswith("bias") else value for key, value in state.items()}
    scaled["features.0.weight"] = scale * state["features.0.weight"]
    torch.save(scaled, tmp_path / "scaled.pth")
    losses = []
    for path in (plain_file, tmp_path / "scaled.pth"):
        rendered, target = load_backbone("auto", path)(images).split(1)
        vectors, style_vectors = (maps.permute(0, 2, 3, 1).flatten(0, 2) for maps in (rendered, target))
        losses.append([content_loss(rendered, target).item(), nnfm_loss(vectors, style_vectors).item()])
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    assert min(losses[0]) > 0.01


# Where weights come from


def test_a_given_file_comes_first_and_decides_which_network_it_is(plain_file, shift_tolerant_file, hub, wheel):
    hub.mkdir(parents=True)
    (hub / vgg.VGG16_FILE).write_bytes(plain_file.read_bytes())
    for path, name in [(plain_file, "vgg16"), (shift_tolerant_file, "vgg16-shift-tolerant")]:
        description = load_backbone("auto", path).description
        assert description.name == name
        assert description.source == f"the file {path}, as asked for"
        assert description.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("backbone", ["auto", "vgg16"])
def test_the_torch_hub_cache_comes_second(backbone, plain_file, hub, wheel):
    hub.mkdir(parents=True)
    (hub / vgg.VGG16_FILE).write_bytes(plain_file.read_bytes())
    description = load_backbone(backbone).description
    assert description.name == "vgg16"
    assert description.source == (
        f"torchvision's VGG-16 (IMAGENET1K_V1) in the torch hub cache, {hub / vgg.VGG16_FILE}"
    )


@pytest.mark.parametrize("backbone", ["auto", "vgg16"])
def test_with_a_network_torchvisions_file_is_downloaded_once(backbone, plain_file, hub, wheel, monkeypatch):
    calls = []

    def download(url, target, hash_prefix, progress):
        calls.append((url, hash_prefix, progress, socket.getdefaulttimeout()))
        Path(target).write_bytes(plain_file.read_bytes())

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    description = load_backbone(backbone).description
    assert description.name == "vgg16"
    assert description.source.startswith("torchvision's VGG-16 (IMAGENET1K_V1), downloaded from https://download.py")
    assert calls == [("https://download.pytorch.org/models/vgg16-397923af.pth", "397923af", False, 5.0)]
    assert socket.getdefaulttimeout() is None
    assert "in the torch hub cache" in load_backbone(backbone).description.source
    assert len(calls) == 1


@pytest.mark.parametrize(
    "failure", [URLError("no network"), TimeoutError(), ConnectionResetError(), RuntimeError("invalid hash value")]
)
def test_without_a_network_the_package_comes_third(failure, wheel, hub, monkeypatch, capsys):
    def download(*args, **kwargs):
        raise failure

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    description = load_backbone("auto").description
    assert description.name == "vgg16-shift-tolerant"
    assert description.source == (
        f"the anti-aliased VGG-16 inside the package stlpips-pytorch, {wheel}; "
        f"torchvision's VGG-16 is not in {hub} and could not be downloaded"
    )
    assert capsys.readouterr() == ("", "")


def test_a_hub_folder_that_cannot_be_made_is_no_obstacle(wheel, tmp_path):
    (tmp_path / "torch").write_text("a file where the folder should be")
    assert load_backbone("auto").description.name == "vgg16-shift-tolerant"


def test_the_shift_tolerant_network_is_taken_on_request_without_asking_the_network(wheel, hub, plain_file):
    hub.mkdir(parents=True)
    (hub / vgg.VGG16_FILE).write_bytes(plain_file.read_bytes())
    description = load_backbone("vgg16-shift-tolerant").description
    assert description.name == "vgg16-shift-tolerant"
    assert description.source == f"the anti-aliased VGG-16 inside the package stlpips-pytorch, {wheel}"


def test_no_code_of_the_package_is_run():
    program = (
        "import sys; from sparsestyle_ns.style.backbones import load_backbone; "
        "assert 'torchvision' not in sys.modules; load_backbone('vgg16-shift-tolerant'); "
        "sys.exit('stlpips_pytorch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


# What is refused


@pytest.mark.parametrize(
    ("backbone", "package"), [("vgg16", "wheel"), ("auto", "no_wheel"), ("vgg16-shift-tolerant", "no_wheel")]
)
def test_where_there_are_no_weights_the_error_names_all_three_ways_out(backbone, package, request, hub):
    request.getfixturevalue(package)
    with pytest.raises(InputError) as caught:
        load_backbone(backbone)
    assert str(caught.value) == (
        f"There are no weights for --backbone {backbone}; give a file with --vgg-weights, or put vgg16-397923af.pth "
        f"into the folder {hub}, or use --backbone vgg16-shift-tolerant (or auto) with the package stlpips-pytorch "
        "installed."
    )


@pytest.mark.parametrize(
    ("file", "backbone", "name"),
    [("plain_file", "vgg16-shift-tolerant", "vgg16"), ("shift_tolerant_file", "vgg16", "vgg16-shift-tolerant")],
)
def test_a_file_of_the_other_network_is_refused(file, backbone, name, request):
    path = request.getfixturevalue(file)
    with pytest.raises(InputError, match=f"is of {name}, not of {backbone}; give another file or --backbone"):
        load_backbone(backbone, path)


def test_a_missing_file_is_named_and_nothing_else_is_taken_instead(tmp_path, wheel):
    with pytest.raises(InputError, match=r"no VGG weight file .*missing\.pth; check the path given as --vgg-weights"):
        load_backbone("auto", tmp_path / "missing.pth")


@pytest.mark.parametrize("kept", [0, 100, 1_000_000])
def test_a_damaged_file_is_refused(kept, plain_file, tmp_path):
    (tmp_path / "damaged.pth").write_bytes(plain_file.read_bytes()[:kept])
    with pytest.raises(
        InputError, match=r"damaged\.pth is damaged or not a PyTorch state dict; fetch it again"
    ) as caught:
        load_backbone("auto", tmp_path / "damaged.pth")
    assert "\n" not in str(caught.value)


def test_a_damaged_file_in_the_cache_is_refused_rather_than_passed_over(hub, wheel):
    hub.mkdir(parents=True)
    (hub / vgg.VGG16_FILE).write_text("half a download")
    with pytest.raises(InputError, match=f"{vgg.VGG16_FILE} is damaged"):
        load_backbone("auto")


def without(key):
    return lambda state: state.pop(key)


def with_entry(key, value):
    return lambda state: state.update({key: value})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (without("features.7.bias"), "features.7.bias is missing"),
        (with_entry("features.2.weight", torch.zeros(64)), "features.2.weight has the shape (64,) instead of"),
        (with_entry("features.14.bias", torch.full((256,), torch.nan)), "features.14.bias has values that are not"),
        (with_entry("features.0.bias", "text"), "features.0.bias is missing"),
        (
            with_entry("features.16.weight", torch.zeros(256, 256, 3, 3)),
            "features.16.weight belongs to another network",
        ),
        (with_entry("features.1.running_mean", torch.zeros(64)), "features.1.running_mean belongs to another network"),
        (lambda state: state.clear(), "features.0.weight is missing"),
    ],
)
def test_a_file_of_something_else_is_refused_with_the_reason(change, reason, tmp_path):
    state = random_state(PLAIN_KEYS)
    change(state)
    torch.save(state, tmp_path / "other.pth")
    with pytest.raises(InputError) as caught:
        load_backbone("auto", tmp_path / "other.pth")
    assert f"other.pth is not VGG-16 up to relu3_3 ({reason}" in str(caught.value)
    assert "give torchvision's vgg16-397923af.pth or ST-LPIPS' vgg_shift_tolerant.pth" in str(caught.value)


def test_a_file_without_a_state_dict_is_refused(tmp_path):
    torch.save(torch.zeros(3), tmp_path / "tensor.pth")
    with pytest.raises(InputError, match="it holds no state dict"):
        load_backbone("auto", tmp_path / "tensor.pth")


def test_a_whole_vgg16_file_of_half_precision_is_accepted(tmp_path, plain_file, images):
    state = {key: value.half() for key, value in torch.load(plain_file).items()}
    state["features.17.weight"] = torch.zeros(1)
    state["classifier.0.weight"] = torch.zeros(1)
    torch.save(state, tmp_path / "half.pth")
    features = load_backbone("vgg16", tmp_path / "half.pth")(images)
    expected = load_backbone("vgg16", plain_file)(images)
    assert features.dtype == torch.float32
    # Rounding each weight to 11 bits moves features by some thousandths of their size, here about 1.
    torch.testing.assert_close(features, expected, rtol=0.01, atol=0.01)
