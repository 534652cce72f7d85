"""The worlds as a `gymnasium.vector.VectorEnv`: many copies of one world, advanced together by compiled rules."""

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs.base import World, check_whole, compile_batch
from envs.drawing import draw


class GridVectorEnv(gymnasium.vector.VectorEnv):
    """`num_envs` independent copies of a world; all agents of a copy act at once and share its reward.

    reset(options={"reset_mask": bool [num_envs]}) resets the masked copies only; there is no automatic reset. A copy that has
    ended stays still at reward 0 and keeps its flags until it is reset. Returned arrays are never written to again.

    reset -> obs, info; step(actions [num_envs, num_agents]) -> obs, reward, terminated, truncated, info with
        obs          float32 [num_envs, num_agents, obs_dim]
        reward       float64 [num_envs], the team's reward
        terminated   bool [num_envs], the world itself has ended
        truncated    bool [num_envs], the time limit has cut it
        info         "outcome" int64 [num_envs] (0: running or cut, k: ended as world.outcome_names[k - 1]),
                     "state" float32 [num_envs, d_s] (everything there is to know, scaled to about [0, 1]),
                     "local_state" int64 [num_envs, num_agents, d] (an agent's own position, facing, and the box)
    """

    def __init__(self, world: World, num_envs: int = 1):
        self.world = world
        self.num_envs = check_whole("num_envs", num_envs, minimum=1)
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": ["rgb_array"]}
        self.render_mode = "rgb_array"
        self.single_observation_space = gymnasium.spaces.Box(0.0, 1.0, (world.num_agents, world.obs_dim), np.float32)
        self.single_action_space = gymnasium.spaces.MultiDiscrete([world.num_actions] * world.num_agents)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._advance, self._look = compile_batch(world.step, world.observe)
        self._state = np.tile(world.start, (num_envs, 1))
        self._clock = np.zeros(num_envs, np.int64)
        self._outcome = np.zeros(num_envs, np.int64)

    def reset(self, *, seed=None, options=None):
        """Start new episodes, in the copies of options["reset_mask"] or in all; the worlds are deterministic, whatever `seed`."""
        super().reset(seed=seed)
        mask = np.asarray(options["reset_mask"]) if options and "reset_mask" in options else np.ones(self.num_envs, bool)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ValueError(f"reset_mask must be booleans of shape {(self.num_envs,)}.")
        self._state[mask] = self.world.start
        self._clock[mask] = 0
        self._outcome[mask] = 0
        return self._see()

    def step(self, actions):
        """One joint action (whole numbers [num_envs, num_agents]) in every copy; see the class for what comes back."""
        world = self.world
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs, world.num_agents) or actions.dtype.kind not in "iu":
            raise ValueError(f"actions must be whole numbers of shape {(self.num_envs, world.num_agents)}.")
        reward = np.empty(self.num_envs)
        flags = np.empty((2, self.num_envs), np.bool_)
        self._advance(
            world.rules, world.num_actions, world.max_steps, self._state, self._clock, self._outcome, actions, reward, flags
        )
        obs, info = self._see()
        return obs, reward, flags[0], flags[1], info

    def _see(self):
        world = self.world
        obs = np.empty((self.num_envs, world.num_agents, world.obs_dim), np.float32)
        state = np.empty(self._state.shape, np.float32)
        local_state = np.empty((self.num_envs, *world.local_index.shape), np.int64)
        self._look(world.rules, world.cell, world.local_index, world.state_scale, self._state, obs, state, local_state)
        return obs, {"outcome": self._outcome.copy(), "state": state, "local_state": local_state}

    def render(self):
        """A tuple with one RGB picture [height, width, 3] (uint8) of every copy."""
        return tuple(self.draw(index) for index in range(self.num_envs))

    def draw(self, index, caption=""):
        """An RGB picture [height, width, 3] (uint8) of one copy, with a line of text beneath."""
        return draw(self.world, self._state[index], caption=caption)
