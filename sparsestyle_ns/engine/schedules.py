"""Learning rates by shares of a run's iterations: a shorter, a longer and a resumed run fall the same way, each to its
end, or as fast as runs of some length do."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Dict, Mapping, Optional, Tuple, Type

import tyro
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from sparsestyle_ns.utils.errors import InputError


@dataclass
class ShareSchedulerConfig(SchedulerConfig):
    """A learning rate over a run: it rises evenly, is multiplied at some moments, and falls exponentially."""

    _target: Type = field(default_factory=lambda: ShareScheduler)
    warm_up: float = 0.0
    """Share of the iterations in which it rises; Adam's first steps are as long as its learning rate, whatever the
    gradient is."""
    milestones: Tuple[float, ...] = ()
    """Shares of the iterations after which it is multiplied by `gamma`."""
    gamma: float = 0.33
    """What each milestone leaves of it."""
    final: float = 1.0
    """What the exponential fall, from the first iteration to the last, leaves of it; 1 is none."""
    longest_fall: Optional[int] = None
    """Iterations in which the exponential fall is over, however many the run has; what they leave is the rest's."""
    iterations: Annotated[Optional[int], tyro.conf.Suppress] = None
    """The run's; filled in when it begins."""

    def factor(self, step: int) -> float:
        """The learning rate in an iteration, from 0, as a share of the optimiser's; InputError for bad settings."""
        total = self.iterations
        assert total is not None
        numbers = self.warm_up, self.gamma, self.final, *self.milestones
        if not all(0.0 <= number <= 1.0 for number in numbers):
            raise InputError(
                f"A learning rate's warm-up, gamma, final and milestones are {numbers}; give shares from 0 to 1 with "
                "--optimizers.GROUP.scheduler."
            )
        if self.longest_fall is not None and self.longest_fall < 1:
            raise InputError(
                f"A learning rate's longest fall is {self.longest_fall}; give 1 iteration or more with "
                "--optimizers.GROUP.scheduler.longest-fall."
            )
        fall = min(total, self.longest_fall or total)
        risen = min(1.0, (step + 1) / max(1, round(self.warm_up * total)))
        falls = sum(step >= round(milestone * total) for milestone in self.milestones)
        return risen * self.gamma**falls * self.final ** min(1.0, step / fall)


class ShareScheduler(Scheduler):
    """See `ShareSchedulerConfig`."""

    config: ShareSchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """The schedule of an optimiser."""
        return LambdaLR(optimizer, self.config.factor)


def over_iterations(optimizers: Mapping[str, Mapping[str, Any]], iterations: int) -> Dict[str, Dict[str, Any]]:
    """A run's optimisers and schedules by group of parameters, with its number of iterations filled in."""
    filled = {}
    for name, group in optimizers.items():
        scheduler = group["scheduler"]
        if isinstance(scheduler, ShareSchedulerConfig):
            scheduler = replace(scheduler, iterations=iterations)
        filled[name] = {**group, "scheduler": scheduler}
    return filled
