"""Which few photos of a scene a run trains on: the protocols of the few-shot literature, or the user's choice."""

from typing import Optional, Sequence, Tuple

from sparsestyle_ns.utils.errors import InputError

BLENDER_VIEWS = (26, 86, 2, 55, 75, 93, 16, 73)
"""The eight frames of `transforms_train.json` that DietNeRF and FreeNeRF train on."""


def evenly_spaced(count: int, num_views: int) -> Tuple[int, ...]:
    """`num_views` of 0 … count − 1, evenly spaced from first to last (RegNeRF's rule, with Python's rounding)."""
    if num_views >= count:
        return tuple(range(count))
    if num_views == 1:
        return (round((count - 1) / 2),)
    return tuple(round(i * (count - 1) / (num_views - 1)) for i in range(num_views))


def select_views(
    available: Sequence[int],
    num_views: Optional[int],
    view_ids: Optional[Sequence[int]],
    default_num_views: int = 8,
    standard: Optional[Sequence[int]] = None,
) -> Tuple[int, ...]:
    """Positions in `available` of the views to train on.

    Args:
        available: ids of the views that may be trained on, in the dataparser's order.
        view_ids: the user's choice of ids, in the order given; overrules `num_views`.
        standard: ids a protocol prescribes, in its order; taken from the front where all of them are available and
            `num_views` is at most their number.

    Raises:
        InputError: an id is not available or given twice, or fewer than one view is asked for.
    """
    if not available:
        raise InputError("The scene has no view that can be trained on; give it photos with camera poses.")
    if view_ids is not None:
        missing = [view for view in view_ids if view not in available]
        if missing:
            raise InputError(
                f"--view-ids names {', '.join(map(str, missing))}, but the views that can be trained on are "
                f"{', '.join(map(str, available))}; choose from these."
            )
        if len(set(view_ids)) != len(view_ids) or not view_ids:
            raise InputError(f"--view-ids is {list(view_ids)}; name at least one view, each only once.")
        return tuple(map(available.index, view_ids))
    wanted = default_num_views if num_views is None else num_views
    if wanted < 1:
        raise InputError(f"--num-views is {wanted}; at least one view is needed.")
    if num_views is not None and num_views > len(available):
        raise InputError(f"--num-views is {num_views}, but only {len(available)} views can be trained on.")
    if standard is not None and wanted <= len(standard) and set(standard) <= set(available):
        return tuple(map(available.index, standard[:wanted]))
    return evenly_spaced(len(available), wanted)
