"""A scene and the presets, with settings changed by their place."""

import pytest

from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.studies.study import flag_of, get_setting, with_setting


def test_a_setting_is_named_as_ns_train_names_it_and_changed_in_a_copy():
    config, place = method_config("coarse-fewshot-draft"), "pipeline.model.coarse_field.layer_width"
    assert flag_of(place) == "--pipeline.model.coarse-field.layer-width"
    changed = with_setting(config, place, 64)
    assert (get_setting(changed, place), get_setting(config, place)) == (64, 256)
    with pytest.raises(AttributeError, match=r"no_such"):
        with_setting(config, "pipeline.model.no_such", 1)


def test_settings_in_dictionaries_and_in_frozen_parts_have_places_too():
    config = method_config("hier-style")
    for place, value in (("optimizers.fields.optimizer.lr", 0.5), ("pipeline.effects.palette", "on")):
        before = get_setting(config, place)
        assert get_setting(with_setting(config, place, value), place) == value
        assert get_setting(config, place) == before != value
