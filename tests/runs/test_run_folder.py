import pytest

from sparsestyle_ns.runs.run_folder import STYLE_METHOD, find_config, read_config
from sparsestyle_ns.utils.errors import InputError


@pytest.mark.parametrize("method", ["coarse-fewshot", "hier-style", "hier-style-draft"])
def test_a_runs_config_is_found_by_its_folder_or_by_itself(tmp_path, method):
    config = tmp_path / "config.yml"
    config.write_text(f"!!python/object:some.Config\nmax_num_iterations: 200\nmethod_name: {method}\n")
    assert find_config(tmp_path) == find_config(config) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("method_name: coarse-fewshot\n", "a run of coarse-fewshot; name a run of hier-style"),
        ("method_name: nerfacto\n", "a run of nerfacto"),
        ("shopping: [bread]\n", "is no config of a nerfstudio run"),
    ],
)
def test_what_is_no_stylised_run_is_refused_where_one_is_needed(tmp_path, text, message):
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(InputError, match=message):
        find_config(tmp_path, STYLE_METHOD)


def test_what_is_missing_is_said(tmp_path):
    with pytest.raises(InputError, match=r"There is no config\.yml in"):
        find_config(tmp_path)
    with pytest.raises(InputError, match="There is no run at"):
        find_config(tmp_path / "gone")


@pytest.mark.parametrize(
    "text", ["method_name: coarse-fewshot\n", "method_name: [coarse\n", "!!python/object:gone.Config {}"]
)
def test_a_config_that_cant_be_read_is_named(tmp_path, text):
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(InputError, match=r"(?s)config\.yml can't be read .*name the folder of a run"):
        read_config(tmp_path)
