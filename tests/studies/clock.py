"""A clock for tests."""


class FakeClock:
    """It goes on when work is done and, if told so, by a little with every look at it."""

    def __init__(self, tick: float = 0.0) -> None:
        self.now, self.tick = 0.0, tick

    def __call__(self) -> float:
        self.now += self.tick
        return self.now

    def work(self, seconds: float) -> None:
        self.now += seconds
