"""What is wrong with the rules of somebody's own world, found by playing them.

Compiled rules read and write beyond the end of an array without a word, and what then goes wrong goes wrong elsewhere. So a
world from a file is first played for some random steps, with room around its arrays. Nothing may change in that room, and the
same actions must always lead to the same, whatever the room is filled with.
"""

import numpy as np

from envs.base import UsageError, World

STEPS, ROOM, FILLERS = 1000, 64, (0, 1, 2)


def try_out(world: World):
    """Play some random steps; UsageError for rules that reach beyond arrays, contradict the world's numbers or are random."""
    world.compiled  # noqa: B018 - says what cannot be compiled
    joint = np.random.default_rng(0).integers(world.num_actions, size=(STEPS, world.num_agents))
    first, *others = [list(played(world, joint, filler)) for filler in FILLERS]
    if any(other != first for other in others):
        raise UsageError(
            f"{world.name}'s rules must be deterministic, but the same actions did not always do the same: they draw random"
            " numbers, or read beyond the end of an array."
        )


def played(world, joint, filler):
    """Yield all that happens in steps with these joint actions [STEPS, num_agents], episode after episode."""
    state, state_room = with_room(world.start, filler)
    actions, actions_room = with_room(joint[0], filler)
    obs, obs_room = with_room(np.zeros((world.num_agents, world.obs_dim), np.float32), filler)
    steps = 0
    for actions[:] in joint:
        reward, outcome = world.step(world.rules, state, actions)
        world.check_outcomes(outcome)
        if not np.isfinite(reward):
            raise UsageError(f"{world.name}'s step must return a finite number as its reward, not {reward}.")
        obs[:] = np.nan
        world.observe(world.rules, world.cell, state, obs)
        if not np.isfinite(obs).all():
            agent, entry = np.argwhere(~np.isfinite(obs))[0]
            raise UsageError(
                f"{world.name}'s observe must write a finite number into all {world.obs_dim} entries of every agent's"
                f" observation, where it is 0, too, and has not into entry {entry} of agent {agent}'s."
            )
        for name, room in (("state", state_room), ("actions", actions_room), ("observations", obs_room)):
            if (room[:ROOM] != filler).any() or (room[-ROOM:] != filler).any():
                raise UsageError(f"{world.name}'s rules write beyond the end of the {name}.")
        yield state.tolist(), obs.tolist(), reward, outcome
        steps += 1
        if outcome or steps == world.max_steps:
            state[:], steps = world.start, 0


def with_room(array, filler):
    """A copy of an array, and the larger one [ROOM + array.size + ROOM] of which it is the middle."""
    room = np.full(array.size + 2 * ROOM, filler, array.dtype)
    middle = room[ROOM:-ROOM].reshape(array.shape)
    middle[:] = array
    return middle, room
