"""A world whose episodes terminate, which the arm's do not."""

import gymnasium
import numpy as np


class Falling(gymnasium.Env):
    """Pays 1 a step and falls in the fifth; starts at a random place."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.normal(size=1).astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.full(1, self.steps, dtype=np.float32), 1.0, self.steps == 5, False, {}
