"""What is said about episodes: the metric of the paper, the curves, and how the trials ended."""

import math

import numpy as np

from envs.base import World, check_memory, check_whole


def reward_per_step(returns, lengths):
    """The paper's "average reward per step" as its authors compute it: return / index of the last step (T - 1, at least 1)."""
    return np.asarray(returns) / np.maximum(np.asarray(lengths) - 1, 1)


def last_episodes(num_episodes: int) -> slice:
    """The last 5 % of the episodes, rounded up: those whose mean is a trial's score."""
    return slice(-math.ceil(num_episodes / 20), None)


class EpisodeLog:
    """Undiscounted team returns, lengths and outcomes of all episodes of all trials, each [num_trials, num_episodes]."""

    def __init__(self, world: World, num_trials: int, num_episodes: int):
        """UsageError if so many do not fit into the memory of this machine."""
        num_trials = check_whole("num_trials", num_trials, minimum=1)
        num_episodes = check_whole("num_episodes", num_episodes, minimum=1)
        check_memory(f"a log of {num_trials} x {num_episodes} episodes", 13 * num_trials * num_episodes)
        self.world = world
        self.returns = np.zeros((num_trials, num_episodes))
        self.lengths = np.zeros((num_trials, num_episodes), np.int32)
        self.outcomes = np.zeros((num_trials, num_episodes), np.int8)

    def add(self, episode: int, reward, lengths, outcomes):
        """Keep one episode of every trial: reward [T, num_trials] (0 after its end), lengths and outcomes [num_trials].

        UsageError for an outcome that is none of the world's.
        """
        self.world.check_outcomes(outcomes)
        self.returns[:, episode] = reward.sum(0)
        self.lengths[:, episode] = lengths
        self.outcomes[:, episode] = outcomes

    def means(self, episodes: slice) -> dict:
        """The means of each trial over some episodes: {curve: [num_trials]}."""
        returns, lengths = self.returns[:, episodes], self.lengths[:, episodes]
        return {
            "episodic_return": returns.mean(1),
            "episodic_length": lengths.mean(1),
            "reward_per_step": reward_per_step(returns, lengths).mean(1),
        }

    def usual_outcomes(self, episodes: slice):
        """The outcome in which most of a trial's episodes ended, [num_trials]."""
        return np.array([np.bincount(trial).argmax() for trial in self.outcomes[:, episodes]])

    def share_at_best(self, episodes: slice) -> float:
        """The share of trials whose usual outcome is the world's best one; nan if the world has no outcomes to be best."""
        if not self.world.outcome_names:
            return float("nan")
        return float(np.mean(self.usual_outcomes(episodes) == self.world.best_outcome))

    def summary(self, episodes: slice) -> str:
        """One line on some episodes: in how many trials they usually ended where, and the reward per step."""
        usual = self.usual_outcomes(episodes)
        names = ("time limit", *self.world.outcome_names)
        ends = ", ".join(f"{np.sum(usual == k)} {name}" for k, name in enumerate(names) if np.any(usual == k))
        score = self.means(episodes)["reward_per_step"]
        spread = f" (worst trial {score.min():.2f}, best {score.max():.2f})" if len(score) > 1 else ""
        return f"usual end: {ends}; reward per step {score.mean():.2f}{spread}"
