"""Ranks: the processes that train one cell together, each some parts or samples of every batch.

Rank 0 runs the cell as a single process would and tells the others what to train. What they share
is little: small plain values, gathered in the order of the ranks, sums of tensors, and tensors side
by side. One rank alone is `Ranks` itself, whose every operation is the identity; there is no
process group then.

Ranks are told who they are by their environment, as torchrun and srun set it, or rank 0 starts the
others itself. All meet at a store that rank 0 serves. There each beats, and watches the others: one
that dies or hangs ends them all, also where a collective of GPUs would wait for ever.
"""

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    import subprocess

    import torch
    from torch import Tensor

    from mtl_bench.core.recipe import Optim

JOIN_S = 300  # for the last rank to come
BEAT_S = 2.0
SILENT = 10  # looks at a rank that did not beat between any two of them: it is gone
LEAVE_S = 5.0  # for the others to end, before rank 0 takes the store away
POLL_S = 0.1
FRAME = 4096  # bytes of a gathered value for which one collective is enough
OWN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
INTERRUPTED = "interrupted"
HERE = "127.0.0.1"


class LostError(Exception):
    """Another rank has ended before its time."""


class Ranks:
    """One rank alone."""

    rank = 0
    size = 1
    local = 0  # among those of this machine

    @property
    def first(self) -> bool:
        """Whether this is rank 0: the one that writes."""
        return self.rank == 0

    def gather(self, value: Any) -> list[Any]:
        """Every rank's plain value, by rank."""
        return [value]

    def sum_(self, tensor: "Tensor") -> "Tensor":
        """A tensor becomes the sum over all ranks."""
        return tensor

    def join(self, tensor: "Tensor") -> "Tensor":
        """Every rank's tensor [n,...], of one shape, one after another by rank: [size*n,...]."""
        return tensor

    def to_first(self, value: Any) -> list[Any]:
        """At rank 0 every rank's value, by rank; nothing at the others.

        Args:
            value: plain, or arrays, in lists and dictionaries.
        """
        return [value]

    def any(self, flag: bool) -> bool:
        return any(self.gather(flag))

    def from_first(self, value: Any) -> Any:
        return self.gather(value)[0]

    def tell(self, task: dict[str, Any], device: "torch.device") -> None:
        """Rank 0 to the others: what to do next, see `Processes.told`."""

    def still_all(self) -> None:
        """Worth a call where ranks work long without sharing anything.

        Raises:
            LostError, KeyboardInterrupt: another rank has ended.
        """

    @contextlib.contextmanager
    def sharing_cores(self) -> Iterator[None]:
        """Inside, ranks that one process has started take a share of its threads each."""
        yield


ALONE = Ranks()


class Processes(Ranks):
    """Several ranks; `with` joins and leaves them.

    Args:
        address: host and port of the store; None: rank 0 starts all others, on this machine, when
            it first has something to tell.
    """

    def __init__(self, rank: int, size: int, local: int, address: tuple[str, int] | None):
        self.rank, self.size, self.local, self.address = rank, size, local, address
        self._others: list[subprocess.Popen[bytes]] = []
        self._tasks = 0
        self._met = self._joined = False
        self._over = threading.Event()

    def __enter__(self) -> Self:
        if self.address is not None:
            self._meet()
        return self

    def _meet(self) -> None:
        """At the store, which rank 0 serves."""
        import socket

        from torch.distributed import TCPStore  # type: ignore[attr-defined]

        wait = timedelta(seconds=JOIN_S)
        host, port = self.address or (HERE, 0)
        # torchrun serves a store itself, at the address that it tells
        serves = self.first and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
        listen = None
        if host == HERE and sys.platform == "linux":
            os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
        if host == HERE and serves:  # no other machine has anything to seek here
            listener = socket.create_server((host, port))
            port, listen = listener.getsockname()[1], listener.detach()
        try:
            self._store = TCPStore(host, port, None, serves, wait, False, master_listen_fd=listen)
            beats = TCPStore(host, port, None, False, wait, False)
        except RuntimeError as error:
            raise ValueError(
                f"rank {self.rank} of {self.size} finds no rank 0 at {host}:{port}: {_line(error)}"
            ) from error
        self._place = host, port
        self._watching = threading.Thread(target=self._watch, args=(beats,), daemon=True)
        self._watching.start()
        self._met = True

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Say why to the others; rank 0 waits for them, as it serves their store."""
        if not self._met:
            return
        self._over.set()
        self._watching.join()
        stopped = isinstance(error, KeyboardInterrupt)
        why = INTERRUPTED if stopped else "" if error is None else _line(error)
        with contextlib.suppress(RuntimeError):  # the store of a rank 0 that was killed
            self._store.set(f"left/{self.rank}", why)
            if self.first:
                end = time.monotonic() + LEAVE_S
                left = [f"left/{rank}" for rank in range(1, self.size)]
                while time.monotonic() < end and not self._store.check(left):
                    if any(other.poll() for other in self._others):
                        break  # one that was killed says no more
                    time.sleep(POLL_S)
        self._end_others()
        if self._joined and error is None:
            import torch

            torch.distributed.destroy_process_group()

    def _end_others(self) -> None:
        end = time.monotonic() + LEAVE_S
        while any(other.poll() is None for other in self._others) and time.monotonic() < end:
            time.sleep(POLL_S)
        for other in self._others:
            other.kill()
            other.wait()

    # --- what ranks share -------------------------------------------------------------------------

    def gather(self, value: Any) -> list[Any]:
        text = json.dumps(value).encode()
        seen = self._gathered(text, FRAME)
        longest = max(int.from_bytes(one[:8]) for one in seen)
        if longest > FRAME - 8:
            seen = self._gathered(text, longest + 8)
        return [json.loads(one[8 : 8 + int.from_bytes(one[:8])]) for one in seen]

    def _gathered(self, text: bytes, room: int) -> list[bytes]:
        """Every rank's text behind its length, cut or filled to so many bytes."""
        import torch

        padded = (len(text).to_bytes(8) + text)[:room].ljust(room, b"\0")
        mine = torch.frombuffer(bytearray(padded), dtype=torch.uint8)
        found = [torch.empty_like(mine) for _ in range(self.size)]
        with self._or_lost():
            torch.distributed.all_gather(found, mine)
        return [one.numpy().tobytes() for one in found]

    def to_first(self, value: Any) -> list[Any]:
        import torch

        found = [None] * self.size if self.first else None
        with self._or_lost():
            torch.distributed.gather_object(value, found)
        return found or []

    def sum_(self, tensor: "Tensor") -> "Tensor":
        import torch

        with self._or_lost():
            torch.distributed.all_reduce(tensor)
        return tensor

    def join(self, tensor: "Tensor") -> "Tensor":
        import torch

        mine = tensor.contiguous().flatten().view(torch.uint8)  # of any type
        found = mine.new_empty(self.size, len(mine))
        with self._or_lost():
            torch.distributed.all_gather(list(found), mine)
        return found.view(tensor.dtype).view(self.size * len(tensor), *tensor.shape[1:])

    @contextlib.contextmanager
    def _or_lost(self) -> Iterator[None]:
        """Say which rank has ended, and why, where that breaks what is done inside."""
        try:
            yield
        except RuntimeError as error:
            end = time.monotonic() + BEAT_S
            while time.monotonic() < end:
                self.still_all()
                time.sleep(POLL_S)
            raise LostError("another rank has gone without a word") from error

    def still_all(self) -> None:
        for rank in range(self.size):
            try:
                ended = rank != self.rank and self._store.check([f"left/{rank}"])
                why = self._store.get(f"left/{rank}").decode() if ended else ""
            except RuntimeError as error:
                raise LostError("rank 0 has gone") from error
            if why == INTERRUPTED:
                raise KeyboardInterrupt(f"rank {rank} was told to stop")
            if ended:
                raise LostError(f"rank {rank} has ended: {why or 'it was done'}")

    # --- what rank 0 tells ------------------------------------------------------------------------

    def tell(self, task: dict[str, Any], device: "torch.device") -> None:
        if not self._met:
            self._enough(device)
            self._meet()
            self._others = [self._started(rank) for rank in range(1, self.size)]
        self._store.set(f"task/{self._tasks}", json.dumps(task))
        self._tasks += 1
        self._join(device)

    def _enough(self, device: "torch.device") -> None:
        """Raises: ValueError: fewer GPUs than ranks that are to be started."""
        import torch

        if device.type == "cuda" and torch.cuda.device_count() < self.size:
            count = torch.cuda.device_count()
            raise ValueError(f"{self.size} ranks, but this process sees {count} GPUs: one each")

    def told(self) -> dict[str, Any] | None:
        """What rank 0 says next; None: no more, it has ended.

        Raises:
            LostError: it has ended without a word.
        """
        key = f"task/{self._tasks}"
        try:
            while not self._store.check([key]):
                if self._store.check(["left/0"]):
                    return None
                time.sleep(POLL_S)
            self._tasks += 1
            task: dict[str, Any] = json.loads(self._store.get(key))
        except RuntimeError as error:
            raise LostError("rank 0 has gone") from error
        return task

    def begin(self, device: "torch.device") -> None:
        """Of a rank that was told what to do: be ready for what ranks share."""
        self._join(device)

    def _join(self, device: "torch.device") -> None:
        import torch
        from torch.distributed import PrefixStore  # type: ignore[attr-defined]

        if self._joined:
            return
        self._joined, cuda = True, device.type == "cuda"
        if cuda:
            torch.cuda.set_device(device)
        self._store.set(f"here/{self.rank}", "")
        with self._or_lost():
            while not self._store.check([f"here/{rank}" for rank in range(self.size)]):
                self.still_all()
                time.sleep(POLL_S)
            torch.distributed.init_process_group(
                "cpu:gloo,cuda:nccl" if cuda else "gloo",
                store=PrefixStore("group", self._store),
                rank=self.rank,
                world_size=self.size,
                timeout=timedelta(days=1),  # who lives is seen by the beats
            )

    def _started(self, rank: int) -> "subprocess.Popen[bytes]":
        """The same command, as another rank."""
        import subprocess

        from mtl_bench.core.provenance import cores

        host, port = self._place
        values = (rank, self.size, rank, host, port)
        environment = {**os.environ, **dict(zip(OWN, map(str, values), strict=True))}
        environment.setdefault("OMP_NUM_THREADS", str(max(1, cores() // self.size)))
        environment.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # rank 0 tells what has happened
        command = [sys.executable, "-m", "mtl_bench", *sys.argv[1:]]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment)

    @contextlib.contextmanager
    def sharing_cores(self) -> Iterator[None]:
        import torch

        from mtl_bench.core.provenance import cores

        before = torch.get_num_threads()
        if self.address is None and "OMP_NUM_THREADS" not in os.environ:
            torch.set_num_threads(max(1, cores() // self.size))
        try:
            yield
        finally:
            torch.set_num_threads(before)

    # --- who lives --------------------------------------------------------------------------------

    def _watch(self, store: Any) -> None:
        """Beat, and end this process when another rank does not any more. Rank 0 is asked to stop
        as by a signal where another one has ended before it."""
        others = [rank for rank in range(self.size) if rank != self.rank]
        beats, looks = dict.fromkeys(others, 0), dict.fromkeys(others, 0)
        lost = ""
        while not lost and not self._over.wait(BEAT_S):
            try:
                store.add(f"beat/{self.rank}", 1)
                for rank in list(others):
                    if store.check([f"left/{rank}"]):
                        others.remove(rank)
                        if self.first:  # before it has said that all is done
                            os.kill(os.getpid(), signal.SIGTERM)
                        continue
                    now = store.add(f"beat/{rank}", 0)
                    looks[rank] = 0 if now != beats[rank] else looks[rank] + 1
                    beats[rank] = now
                    if looks[rank] >= (SILENT if now else JOIN_S / BEAT_S):
                        lost = f"rank {rank} of {self.size} is not to be heard any more"
            except RuntimeError:
                lost = "rank 0 has gone"
        if lost and not self._over.wait(2 * BEAT_S):  # who waits for that rank may say more
            print(f"mtl-bench: rank {self.rank} ends: {lost}", file=sys.stderr, flush=True)
            for other in self._others:
                other.kill()
            os._exit(1)


def joined(count: int | None = None) -> contextlib.AbstractContextManager[Ranks]:
    """This process among its ranks, which `with` joins and leaves.

    Args:
        count: of them, to be started where the environment does not make this one of several.

    Raises:
        ValueError: an environment that says only half of it.
    """
    found = _by_environment()
    if found is not None:
        return found
    if (count or 1) > 1:
        assert count is not None
        return Processes(0, count, 0, None)
    return contextlib.nullcontext(ALONE)


def _by_environment() -> Processes | None:
    """As torchrun sets it, or else srun: of a step of several tasks each is a rank."""
    env = os.environ
    if "WORLD_SIZE" in env:
        if _whole("WORLD_SIZE") == 1:
            return None
        lacking = [name for name in OWN if name not in env]
        if lacking:
            raise ValueError(f"WORLD_SIZE = {env['WORLD_SIZE']} is set, but not {lacking[0]}")
        rank, size, local = map(_whole, OWN[:3])
        return Processes(rank, size, local, (env["MASTER_ADDR"], _whole("MASTER_PORT")))
    size = int(env.get("SLURM_STEP_NUM_TASKS", "1"))
    if size == 1:
        return None
    import subprocess

    told = ["scontrol", "show", "hostnames", env["SLURM_STEP_NODELIST"]]
    nodes = subprocess.run(told, check=True, capture_output=True, text=True).stdout.split()
    port = 20000 + (int(env["SLURM_JOB_ID"]) * 16 + int(env["SLURM_STEP_ID"])) % 20000
    rank, local = int(env["SLURM_PROCID"]), int(env["SLURM_LOCALID"])
    return Processes(rank, size, local, (nodes[0] if len(nodes) > 1 else HERE, port))


def _whole(name: str) -> int:
    """A number of the environment."""
    value = os.environ[name]
    if not value.isdecimal():
        raise ValueError(f"{name} = {value!r} is set, and is no whole number: unset it")
    return int(value)


def check_share(optim: "Optim", size: int) -> None:
    """Raises: ValueError: so many ranks cannot have equally many parts, or samples, of a batch."""
    if optim.one_batch:
        if optim.batch % size:
            raise ValueError(
                f"{size} ranks cannot share the {optim.batch} samples of a batch: take a number of "
                f"ranks that divides recipe.optim.batch"
            )
        return
    parts = optim.batch // (optim.micro_batch or optim.batch)
    if parts % size:
        raise ValueError(
            f"{size} ranks cannot share the {parts} part{'s' * (parts > 1)} of a batch: "
            f"recipe.optim.micro_batch = {optim.micro_batch or 'none'} of recipe.optim.batch = "
            f"{optim.batch}; set micro_batch, or take a number of ranks that divides {parts}"
        )


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]
