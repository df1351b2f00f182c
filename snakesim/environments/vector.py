"""Steps many environments at once: one process for each processor, and each steps its share of the environments.

With one process for each environment, a step waits for the slowest process, and every environment pays for its own
messages.
"""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
from gymnasium import error
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from numpy.typing import NDArray

from snakesim.environments.environment import SnakeEnv
from snakesim_hal.base.errors import BackendError, ConfigError

CLOSE_TIMEOUT_S = 5.0
CLOSE = "close"  # a request without an answer
Outcome = tuple[Any, float, bool, bool, dict[str, Any]]


class SnakeVectorEnv(VectorEnv[Any, Any, Any]):
    """Many environments of one scenario. The step after the end of an episode resets it, as Gymnasium's own do.

    An unpickled one starts new processes, and needs a `reset`.
    """

    metadata = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs: int = 1, *, processes: int | None = None, **arguments: Any) -> None:
        """Start the processes.

        Args:
            num_envs: Number of environments.
            processes: Number of processes; None starts one for each processor that this process may use.
            **arguments: Those of `SnakeEnv`.

        Raises:
            ConfigError: An argument is wrong. It is raised here rather than in a process.
        """
        if num_envs < 1 or (processes is not None and processes < 1):
            raise ConfigError(
                f"num_envs={num_envs!r}, processes={processes!r}: give whole numbers, 1 or more",
                code="python/invalid-argument",
            )
        self._arguments = {"num_envs": num_envs, "processes": processes, **arguments}
        example = SnakeEnv(**arguments)
        self._example = example
        self.num_envs = num_envs
        self.render_mode = example.render_mode
        self.metadata = {**self.metadata, "render_fps": example.metadata["render_fps"]}
        self.single_observation_space = example.observation_space
        self.single_action_space = example.action_space
        self.observation_space = batch_space(example.observation_space, num_envs)
        self.action_space = batch_space(example.action_space, num_envs)
        available = len(os.sched_getaffinity(0))
        count = min(processes or available, num_envs)
        self._shares = [part.tolist() for part in np.array_split(np.arange(num_envs), count)]
        self._workers = _Workers([len(share) for share in self._shares], arguments)
        self._unequal = False  # a request has not reached all environments, or not all have answered it

    def __reduce__(self) -> Any:
        return _rebuild_vector, (type(self), self._arguments, self.spec)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all environments.

        Args:
            seed: Seed of the first environment, the next ones count up; or one seed for each environment.
            options: `reset_mask` is not supported; nothing else is read.

        Returns:
            Observations of all environments, stacked, and their merged info dicts.

        Raises:
            gymnasium.error.Error: A seed is not a Python integer of 0 or more, as in Gymnasium.
            ValueError: The number of seeds is wrong, or `options` has a `reset_mask`.
        """
        if options and "reset_mask" in options:
            raise ValueError("options['reset_mask'] is not supported: every environment is reset; leave it out")
        seeds = _spread_seeds(seed, self.num_envs)
        self._unequal = True
        results = self._request("reset", seeds)
        self._unequal = False
        observations = [observation for observation, _ in results]
        infos = [info for _, info in results]
        return self._stack(observations), self._merge(infos)

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Step every environment.

        Args:
            actions: (num_envs, joints) actions, a row for each environment.

        Returns:
            Stacked observations; rewards, terminated and truncated, each (num_envs,); and merged info dicts.

        Raises:
            gymnasium.error.ResetNeeded: The step or reset before this one did not finish, by Ctrl-C for example.
            ValueError: The number of rows is wrong, or a row is no action. No environment has taken a step then.
        """
        if len(actions) != self.num_envs:
            raise ValueError(f"actions has {len(actions)} rows, must have {self.num_envs}: one an environment")
        for action in actions:
            self._example.check_action(action)  # here, so that all environments take the step or none does
        if self._unequal:
            raise error.ResetNeeded(
                "the last step or reset did not finish, so some environments may be a step ahead of the others; "
                "call reset()"
            )
        self._unequal = True
        outcomes = self._request("step", actions)
        self._unequal = False
        observations, rewards, terminated, truncated, infos = zip(*outcomes, strict=True)
        return (
            self._stack(observations),
            np.array(rewards, dtype=np.float64),
            np.array(terminated, dtype=np.bool_),
            np.array(truncated, dtype=np.bool_),
            self._merge(infos),
        )

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of each environment; None without a `render_mode`."""
        if self.render_mode is None:
            return None
        return tuple(self._request("render", [None] * self.num_envs))

    def close_extras(self, **_named: Any) -> None:
        """End the processes."""
        self._workers.close()

    def _request(self, method: str, arguments: Sequence[Any]) -> list[Any]:
        """Call a method of all environments with one argument each; return the results in their order."""
        shares = [[arguments[i] for i in share] for share in self._shares]
        return self._workers.request(method, shares)

    def _stack(self, observations: Sequence[Any]) -> Any:
        """Return the observations of all environments as one batch."""
        space = self.single_observation_space
        return concatenate(space, observations, create_empty_array(space, self.num_envs))

    def _merge(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        merged: dict[str, Any] = {}
        for number, info in enumerate(infos):
            merged = self._add_info(merged, info, number)
        return merged


def _rebuild_vector(env_class: type[SnakeVectorEnv], arguments: dict[str, Any], spec: Any) -> SnakeVectorEnv:
    """Return a new vector environment like the one that was pickled."""
    env = env_class(**arguments)
    env.spec = spec
    return env


def _spread_seeds(seed: Any, count: int) -> list[int | None]:
    """Return a seed for each environment, by the rules of Gymnasium.

    Raises:
        gymnasium.error.Error: A seed is not a Python integer of 0 or more.
        ValueError: There is not one seed for each environment.
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, int):
        _check_seed("seed", seed)
        return [seed + number for number in range(count)]
    try:
        seeds = list(seed)
    except TypeError:
        _check_seed("seed", seed)
        raise
    if len(seeds) != count:
        raise ValueError(f"seed has {len(seeds)} entries, must be one number, or {count}")
    for number, seed_of_env in enumerate(seeds):
        _check_seed(f"seed[{number}]", seed_of_env)
    return seeds


def _check_seed(name: str, seed: Any) -> None:
    """Raise gymnasium.error.Error, with the name of the argument, for what is no seed."""
    try:
        np_random(seed)
    except error.Error as refusal:
        raise error.Error(f"{name} is {seed!r:.60}: {refusal}") from None


class _Workers:
    """Processes with environments, and the numbered requests to them.

    The number distinguishes an answer from that to an earlier request, whose caller was interrupted before the answer
    came, by Ctrl-C for example.
    """

    def __init__(self, counts: Sequence[int], arguments: dict[str, Any]) -> None:
        """Start a process for each count of environments."""
        self._number = 0
        self._mid_message = False
        self._ends: list[Connection] = []
        self._processes: list[multiprocessing.Process] = []
        with _interrupts_blocked():  # a worker inherits this, until it ignores them
            for count in counts:
                ours, theirs = multiprocessing.Pipe()
                ends_of_parent = [*self._ends, ours]
                process = multiprocessing.Process(target=_work, args=(theirs, ends_of_parent, count, arguments))
                process.daemon = True  # it ends with this process
                process.start()
                theirs.close()
                self._ends.append(ours)
                self._processes.append(process)

    def request(self, method: str, shares: Sequence[Sequence[Any]]) -> list[Any]:
        """Call a method of all environments, in all processes at the same time.

        Args:
            method: Name of a method of `_Seat`, or CLOSE.
            shares: For each process, one argument for each of its environments.

        Returns:
            The results of all environments, in their order.

        Raises:
            BackendError: A process has ended, or a message was cut off.
            Exception: What an environment has raised.
        """
        if self._mid_message:
            raise BackendError(
                "an interrupt has cut off a message between the processes of these environments; make them anew"
            )
        self._number += 1
        answers: list[Any] = []
        errors: list[Exception] = []
        try:
            for end, share in zip(self._ends, shares, strict=True):
                self._send(end, (self._number, method, share))
            for end in self._ends:
                answer = self._receive(end)
                if isinstance(answer, Exception):
                    errors.append(answer)
                else:
                    answers += answer
        except (EOFError, ConnectionError):
            raise BackendError("a process with environments has ended; see its output above") from None
        if errors:
            raise errors[0]
        return answers

    def close(self) -> None:
        """End the processes."""
        for end in self._ends:
            # A process that was forked later, for other environments, holds a copy of this end: closing is not enough.
            with contextlib.suppress(OSError):
                end.send((self._number, CLOSE, []))
            end.close()
        for process in self._processes:
            process.join(CLOSE_TIMEOUT_S)
            if process.is_alive():
                process.kill()

    def _send(self, end: Connection, message: Any) -> None:
        self._mid_message = True
        end.send(message)
        self._mid_message = False

    def _receive(self, end: Connection) -> Any:
        """Return the answer to the newest request, and drop those to interrupted ones."""
        while True:
            wait([end])  # interrupts come here, between two messages, as good as always
            self._mid_message = True
            number, answer = end.recv()
            self._mid_message = False
            if number == self._number:
                return answer


class _Seat:
    """One environment, which resets itself in the step after the end of an episode."""

    def __init__(self, arguments: dict[str, Any]) -> None:
        self._env = SnakeEnv(**arguments)
        self._over = False

    def reset(self, seed: int | None) -> tuple[Any, dict[str, Any]]:
        self._over = False
        return self._env.reset(seed=seed)

    def step(self, action: Any) -> Outcome:
        if self._over:
            observation, info = self.reset(None)
            return observation, 0.0, False, False, info
        observation, reward, terminated, truncated, info = self._env.step(action)
        self._over = terminated or truncated
        return observation, reward, terminated, truncated, info

    def render(self, _nothing: None) -> Any:
        return self._env.render()


def _work(end: Connection, ends_of_parent: Sequence[Connection], count: int, arguments: dict[str, Any]) -> None:
    """Serve requests until the parent's end is closed; the main function of a worker process.

    Args:
        end: This worker's end of its pipe.
        ends_of_parent: Ends that a fork has copied; they must close with their owner.
        count: Number of environments.
        arguments: Those of `SnakeEnv`.
    """
    # Ctrl-C reaches all processes of a terminal. What it ends is decided by the parent alone.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    for other in ends_of_parent:
        other.close()
    seats = [_Seat(arguments) for _ in range(count)]
    while True:
        try:
            number, method, share = end.recv()
            if method == CLOSE:
                return
            try:
                answer: Any = [getattr(seat, method)(argument) for seat, argument in zip(seats, share, strict=True)]
            except Exception as raised:  # noqa: BLE001 - the parent raises it, whatever it is
                answer = raised
            end.send((number, answer))
        except (EOFError, ConnectionError):
            return


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Keep SIGINT waiting for this thread, and for processes that it starts."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
