"""Many environments at once: a process for each processor, each with its share of them, one after the other.

With a process for each environment, a step waits for the slowest, and every environment pays for its own messages.
"""

import multiprocessing
import os
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from numpy.typing import NDArray

from snakesim.environments.environment import SnakeEnv
from snakesim_hal.errors import BackendError, ConfigError

LEAVE_S = 5.0
Outcome = tuple[Any, float, bool, bool, dict[str, Any]]


class SnakeVectorEnv(VectorEnv[Any, Any, Any]):
    """Environments of one scenario. After the end of an episode the next step resets it, as Gymnasium's own do."""

    metadata = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs: int = 1, *, processes: int | None = None, **arguments: Any) -> None:
        """processes: None: one for each processor that this one may use. arguments: those of `SnakeEnv`.

        Raises ConfigError for wrong input, here rather than in a process.
        """
        if num_envs < 1 or (processes is not None and processes < 1):
            raise ConfigError(f"num_envs={num_envs!r}, processes={processes!r}: give whole numbers, 1 or more")
        one = SnakeEnv(**arguments)
        self.num_envs, self.render_mode = num_envs, one.render_mode
        self.metadata = {**self.metadata, "render_fps": one.metadata["render_fps"]}
        self.single_observation_space, self.single_action_space = one.observation_space, one.action_space
        self.observation_space = batch_space(one.observation_space, num_envs)
        self.action_space = batch_space(one.action_space, num_envs)
        count = min(processes or len(os.sched_getaffinity(0)), num_envs)
        self._shares = [part.tolist() for part in np.array_split(np.arange(num_envs), count)]
        self._ends: list[Connection] = []
        self._workers: list[multiprocessing.Process] = []
        for share in self._shares:
            ours, theirs = multiprocessing.Pipe()
            worker = multiprocessing.Process(target=_work, args=(theirs, [*self._ends, ours], len(share), arguments))
            worker.daemon = True  # it ends with this process
            worker.start()
            theirs.close()
            self._ends.append(ours)
            self._workers.append(worker)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """All of them. seed: of the first one, the next ones count up; or one for each."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed or [None] * self.num_envs
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} entries, must be one number, or {self.num_envs}")
        found = self._ask("reset", seeds)
        return self._joined([observation for observation, _ in found]), self._merged([info for _, info in found])

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """An action for each, (num_envs, joints)."""
        if len(actions) != self.num_envs:
            raise ValueError(f"actions has {len(actions)} rows, must have {self.num_envs}: one an environment")
        seen, rewards, terminated, truncated, infos = zip(*self._ask("step", actions), strict=True)
        ended = np.array(terminated, dtype=np.bool_), np.array(truncated, dtype=np.bool_)
        return self._joined(seen), np.array(rewards, dtype=np.float64), *ended, self._merged(infos)

    def render(self) -> tuple[Any, ...] | None:
        """A picture of each."""
        return None if self.render_mode is None else tuple(self._ask("render", [None] * self.num_envs))

    def close_extras(self, **_named: Any) -> None:
        """End the processes."""
        for end in self._ends:
            end.close()
        for worker in self._workers:
            worker.join(LEAVE_S)
            if worker.is_alive():
                worker.kill()

    def _ask(self, what: str, each: Sequence[Any]) -> list[Any]:
        """Have every process do it for its share, at the same time. Raises what one of them has raised."""
        found: list[Any] = []
        errors: list[Exception] = []
        try:
            for end, share in zip(self._ends, self._shares, strict=True):
                end.send((what, [each[i] for i in share]))
            for end in self._ends:
                answer = end.recv()
                if isinstance(answer, Exception):
                    errors.append(answer)
                else:
                    found += answer
        except (EOFError, ConnectionError):
            raise BackendError("a process with environments has ended; see what it said above") from None
        if errors:
            raise errors[0]
        return found

    def _joined(self, observations: Sequence[Any]) -> Any:
        space = self.single_observation_space
        return concatenate(space, observations, create_empty_array(space, self.num_envs))

    def _merged(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        merged: dict[str, Any] = {}
        for number, info in enumerate(infos):
            merged = self._add_info(merged, info, number)
        return merged


class _Seat:
    """One environment, which resets itself in the step after its end."""

    def __init__(self, arguments: dict[str, Any]) -> None:
        self._env, self._over = SnakeEnv(**arguments), False

    def reset(self, seed: int | None) -> tuple[Any, dict[str, Any]]:
        self._over = False
        return self._env.reset(seed=seed)

    def step(self, action: Any) -> Outcome:
        if self._over:
            observation, info = self.reset(None)
            return observation, 0.0, False, False, info
        outcome = self._env.step(action)
        self._over = outcome[2] or outcome[3]
        return outcome

    def render(self, _nothing: None) -> Any:
        return self._env.render()


def _work(end: Connection, not_ours: Sequence[Connection], count: int, arguments: dict[str, Any]) -> None:
    """In a process of its own. not_ours: ends that a fork has copied, and which must close with their owner."""
    for other in not_ours:
        other.close()
    seats = [_Seat(arguments) for _ in range(count)]
    while True:
        try:
            what, each = end.recv()
            try:
                answer: Any = [getattr(seat, what)(one) for seat, one in zip(seats, each, strict=True)]
            except Exception as error:  # noqa: BLE001 - whatever it is, the one who asked gets it
                answer = error
            end.send(answer)
        except (EOFError, ConnectionError, KeyboardInterrupt):
            return
