"""Our hash grid against nerfstudio's torch implementation: the same table, fresh random points each time."""

from typing import Tuple

import torch
import tyro
from torch import Tensor, nn

from benchmarks._measure import Options, Report, check_equal, ratio_of_pairs, timed
from benchmarks._scene import hash_encoding_like
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.utils.errors import exit_on_input_error

POINTS = 65_536
FORWARD_TARGET, BACKWARD_TARGET = 5.0, 3.0


@exit_on_input_error
def main(options: Options) -> None:
    """Measures the forward pass, and the forward and backward pass together."""
    report = Report("hash_grid", options)
    points = POINTS // 16 if options.quick else POINTS
    # Values of about 1, so that a wrong row shows.
    ours = HashGrid(log2_table_size=14 if options.quick else 19, init_scale=1.0).to(report.device)
    peer = hash_encoding_like(ours)
    direction = torch.randn(points, ours.get_out_dim(), device=report.device)

    def positions(repetition: int) -> Tuple[Tensor]:
        generator = torch.Generator().manual_seed(repetition + 2)
        return (torch.rand(points, 3, generator=generator).to(report.device),)

    def fresh(module: nn.Module):
        def prepare(repetition: int) -> Tuple[nn.Module, Tensor]:
            module.zero_grad()
            return module, *positions(repetition)

        return prepare

    def forward_backward(module: nn.Module, where: Tensor) -> None:
        module(where).backward(direction)

    (where,) = positions(0)
    for module in (ours, peer):
        forward_backward(module, where)
    check_equal(ours(where), peer(where), "features", tolerance=1e-5)
    check_equal(ours.table.grad, peer.hash_table.grad, "gradients of the table", tolerance=1e-5)

    report.notes.append("The forward pass alone runs without gradients, as in rendering.")
    report.extra["settings"] = {"points": points, "levels": list(ours.resolutions), "table_size": ours.table_size}
    repeats = options.repetitions(20)
    with torch.no_grad():
        found = report.measure(
            "forward",
            {"ours": timed(ours, report.device, positions), "nerfstudio": timed(peer, report.device, positions)},
            repeats,
        )
    ratio = ratio_of_pairs(found["nerfstudio"], found["ours"])
    what, against = f"hash grid, {points:,} points", "nerfstudio's HashEncoding in torch"
    report.add_row("hash_grid_forward", f"{what}, forward", against, ratio, FORWARD_TARGET)

    contenders = {"ours": ours, "nerfstudio": peer}
    measures = {name: timed(forward_backward, report.device, fresh(module)) for name, module in contenders.items()}
    found = report.measure("forward_backward", measures, repeats)
    ratio = ratio_of_pairs(found["nerfstudio"], found["ours"])
    report.add_row("hash_grid_forward_backward", f"{what}, forward and backward", against, ratio, BACKWARD_TARGET)
    report.write()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
