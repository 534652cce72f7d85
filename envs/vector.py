"""The worlds as a `gymnasium.vector.VectorEnv`: many copies of one world, advanced together by compiled rules."""

from functools import partial

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs.base import World, check_memory, check_seed, check_whole, compile_batch
from envs.drawing import draw


class GridVectorEnv(gymnasium.vector.VectorEnv):
    """`num_envs` independent copies of a world; all agents of a copy act at once and share its reward.

    reset(options={"reset_mask": bool [num_envs]}) resets the masked copies only; there is no automatic reset. A copy that has
    ended stays still at reward 0 and keeps its flags until it is reset. Returned arrays are never written to again; they are
    parts of larger ones, so copy what is to be kept for long.

    reset -> obs, info; step(actions [num_envs, num_agents]) -> obs, reward, terminated, truncated, info with
        obs          float32 [num_envs, num_agents, obs_dim]
        reward       float64 [num_envs], the team's reward
        terminated   bool [num_envs], the world itself has ended
        truncated    bool [num_envs], the time limit has cut it
        info         "outcome" int64 [num_envs] (0: running or cut, k: ended as world.outcome_names[k - 1]),
                     "state" float32 [num_envs, d_s] (everything there is to know, scaled to about [0, 1]),
                     "local_state" int64 [num_envs, num_agents, d] (an agent's own position and facing, and the boxes)
    """

    def __init__(self, world: World, num_envs: int = 1):
        self.world = world
        self.num_envs = num_envs = check_whole("num_envs", num_envs, minimum=1)
        numbers = 3 * len(world.start) + world.local_index.size + world.num_agents * (world.obs_dim + 4)  # of a copy
        check_memory(f"{num_envs} copies of {world.name}", 8 * num_envs * numbers)
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": ["rgb_array"], "render_fps": 10}
        self.render_mode = "rgb_array"
        self.single_observation_space = gymnasium.spaces.Box(0.0, 1.0, (world.num_agents, world.obs_dim), np.float32)
        self.single_action_space = gymnasium.spaces.MultiDiscrete([world.num_actions] * world.num_agents)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._initial = np.array([0, 0, *world.start])  # outcome, number of steps, state
        self._memory = np.tile(self._initial, (num_envs, 1))
        look, advance = compile_batch(world.step, world.observe)
        fixed = (world.rules, world.cell, world.local_index, world.state_scale, self._memory)
        self._look = partial(look, *fixed)
        self._advance = partial(advance, *fixed, world.num_actions, world.max_steps)
        self._actions = np.zeros((num_envs, world.num_agents), np.int64)
        self._was_reset = False
        self._spare = iter(())

    def reset(self, *, seed=None, options=None):
        """Start new episodes in the copies of options["reset_mask"] or in all; worlds are deterministic, whatever `seed`.

        ValueError for another option, a mask of another shape or type, or a seed that is not a whole number of at least 0.
        """
        super().reset(seed=check_seed(seed))
        options = {} if options is None else dict(options)
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)))
        if options:
            raise ValueError(f"reset has no option {next(iter(options))!r}; it takes reset_mask.")
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask must be booleans of shape {(self.num_envs,)}.")
        self._memory[mask] = self._initial
        self._was_reset = True
        *_, outcome, obs, state, local_state = next(self._spare, None) or self._make_spare()
        outcome[:] = self._memory[:, 0]
        self._look(obs, state, local_state)
        return obs, {"outcome": outcome, "state": state, "local_state": local_state}

    def step(self, actions):
        """One joint action (whole numbers [num_envs, num_agents]) in every copy; see the class for what comes back.

        ValueError for actions of another shape, type or value, and before the first reset.
        """
        actions = np.asarray(actions)
        if actions.shape != self._actions.shape or actions.dtype.kind not in "iu":
            raise ValueError(f"actions must be whole numbers of shape {self._actions.shape}.")
        if not self._was_reset:
            raise ValueError("no episode is under way; reset() starts one.")
        self._actions[...] = actions  # the rules are compiled for one type, byte order and layout
        reward, terminated, truncated, outcome, obs, state, local_state = next(self._spare, None) or self._make_spare()
        if not self._advance(self._actions, reward, terminated, truncated, outcome, obs, state, local_state):
            raise ValueError(f"actions must be between 0 and {self.world.num_actions - 1}.")
        return obs, reward, terminated, truncated, {"outcome": outcome, "state": state, "local_state": local_state}

    def _make_spare(self):
        """Make fresh arrays for what the next steps return, for many at once, which is quicker; returns the first step's."""
        world, steps = self.world, 1 + 1000 // self.num_envs
        kinds = [
            ((), np.float64),  # reward
            ((), np.bool_),  # terminated
            ((), np.bool_),  # truncated
            ((), np.int64),  # outcome
            ((world.num_agents, world.obs_dim), np.float32),  # obs
            (world.start.shape, np.float32),  # state
            (world.local_index.shape, np.int64),  # local_state
        ]
        self._spare = zip(*[np.empty((steps, self.num_envs, *shape), dtype) for shape, dtype in kinds], strict=True)
        return next(self._spare)

    @property
    def states(self):
        """The state of every copy in whole numbers, [num_envs, state_dim]; a copy."""
        return self._memory[:, 2:].copy()

    def render(self):
        """A tuple with one RGB picture [height, width, 3] (uint8) of every copy."""
        return tuple(self.draw(index) for index in range(self.num_envs))

    def draw(self, index, caption=""):
        """An RGB picture [height, width, 3] (uint8) of one copy, with a line of text beneath."""
        return draw(self.world, self._memory[index, 2:], caption=caption)
