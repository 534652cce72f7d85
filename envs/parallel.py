"""The worlds as PettingZoo's `ParallelEnv`: one world, agents by name, for libraries that train on PettingZoo environments."""

import gymnasium
import numpy as np
from pettingzoo import ParallelEnv

from envs.base import World, check_choice, check_seed
from envs.drawing import draw, text_map

RENDER_MODES = ("rgb_array", "ansi", "human")


class GridParallelEnv(ParallelEnv):
    """A world whose agents "agent_0", "agent_1", ... act at once; every one of them gets the team's reward.

    reset -> obs, infos; step({agent: action}) -> obs, rewards, terminations, truncations, infos, each a dictionary by agent:
        obs            float32 [obs_dim], an array that is never written to again
        rewards        the team's reward
        terminations   whether the world itself has ended
        truncations    whether the time limit has cut it
        infos          {"outcome": 0 while it runs or if it was cut, k if it has ended as world.outcome_names[k - 1]}
    `state()` is everything there is to know, float32 [d_s], scaled to about [0, 1]. All agents leave when the episode ends.
    `render()` gives a picture, uint8 [height, width, 3], with render_mode "rgb_array" and a map in letters with "ansi"; with
    "human" it shows the picture in a matplotlib window, which happens by itself after every reset and step.
    """

    def __init__(self, world: World, render_mode: str | None = None):
        self.world = world
        self.metadata = {"name": world.name, "render_modes": list(RENDER_MODES), "render_fps": 10, "is_parallelizable": True}
        self.render_mode = None if render_mode is None else check_choice("render_mode", render_mode, RENDER_MODES)
        self.possible_agents = [f"agent_{i}" for i in range(world.num_agents)]
        self.agents = []
        self.observation_spaces = {
            agent: gymnasium.spaces.Box(0.0, 1.0, (world.obs_dim,), np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {agent: gymnasium.spaces.Discrete(world.num_actions) for agent in self.possible_agents}
        self.state_space = gymnasium.spaces.Box(0.0, 1.0, world.start.shape, np.float32)
        self._state, self._clock = world.start.copy(), 0
        self._window = None

    def observation_space(self, agent):
        """What `agent` observes, a Box."""
        return self.observation_spaces[agent]

    def action_space(self, agent):
        """What `agent` can do, Discrete; world.action_names says what the numbers mean."""
        return self.action_spaces[agent]

    def reset(self, seed=None, options=None):
        """Start a new episode; the worlds are deterministic, whatever `seed` and `options` (PettingZoo's test gives some).

        UsageError for a seed that is not a whole number of at least 0.
        """
        check_seed(seed)
        self.agents = list(self.possible_agents)
        self._state, self._clock = self.world.start.copy(), 0
        if self.render_mode == "human":
            self.render()
        return self._observe(), {agent: {"outcome": 0} for agent in self.agents}

    def step(self, actions):
        """One action of every agent, {agent: whole number}; see the class for what comes back.

        ValueError if an action is missing or impossible, or no episode is under way.
        """
        world, agents = self.world, self.agents
        if not agents:
            raise ValueError("no episode is under way; reset() starts one.")
        if set(actions) != set(agents):
            raise ValueError(f"actions must be of {', '.join(agents)}, not of {', '.join(map(str, actions)) or 'nobody'}.")
        for agent, action in actions.items():
            if isinstance(action, bool) or action not in self.action_spaces[agent]:
                raise ValueError(f"{agent}'s action must be a whole number from 0 to {world.num_actions - 1}, not {action!r}.")
        joint = np.array([int(actions[agent]) for agent in agents])
        reward, outcome = world.step(world.rules, self._state, joint)
        self._clock += 1
        terminated = outcome > 0
        truncated = not terminated and self._clock >= world.max_steps
        if terminated or truncated:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        infos = {agent: {"outcome": int(outcome)} for agent in agents}
        return self._observe(), *(dict.fromkeys(agents, value) for value in (float(reward), terminated, truncated)), infos

    def _observe(self):
        obs = np.empty((self.world.num_agents, self.world.obs_dim), np.float32)
        self.world.observe(self.world.rules, self.world.cell, self._state, obs)
        return dict(zip(self.possible_agents, obs, strict=True))

    def state(self):
        """Everything there is to know, float32 [d_s], scaled to about [0, 1]."""
        return (self._state * self.world.state_scale).astype(np.float32)

    def render(self):
        """A picture, a map in letters, or None after showing the picture in a window, as render_mode says."""
        if self.render_mode == "rgb_array":
            return draw(self.world, self._state)
        if self.render_mode == "ansi":
            return text_map(self.world, self._state)
        if self.render_mode == "human":
            self._show(draw(self.world, self._state))
        else:
            gymnasium.logger.warn("render() shows nothing, because no render_mode was chosen when the environment was made.")
        return None

    def _show(self, picture):
        import matplotlib.pyplot as plt  # only here: importing it takes longer than everything else

        if self._window is None:
            self._window, axes = plt.subplots(figsize=(5, 5), num=self.world.name, clear=True)
            axes.imshow(picture)
            axes.set_axis_off()
        self._window.axes[0].images[0].set_data(picture)
        plt.pause(1 / self.metadata["render_fps"])

    def close(self):
        """Close the window, if there is one."""
        if self._window is not None:
            import matplotlib.pyplot as plt

            plt.close(self._window)
            self._window = None
