"""Several processes as one run: joining them, and ending all of them when one fails or hangs."""

import contextlib
import faulthandler
import io
import os
import sys
import traceback
from collections.abc import Iterator
from datetime import timedelta

import torch
from torch.distributed import PrefixStore
from torch.distributed.rendezvous import rendezvous

from vd.command.files import OutputError

START_TIMEOUT = timedelta(minutes=20)
"""Longest wait for the slowest process to build its environments; compiling kernels takes 3
minutes.
"""
COLLECTIVE_TIMEOUT = timedelta(minutes=2)
"""Longest wait in a collective: an iteration takes about a second and a checkpoint a few. NCCL's
default of 10 minutes is that much of every GPU lost when one process hangs."""
REPORT_AFTER_S = 90.0
"""An iteration that takes this long is reported, before the others' wait in a collective ends."""


def join_processes(device: str) -> tuple[int, int]:
    """Meet the other processes that ``torchrun`` started, if it did; NCCL on GPUs, gloo on CPUs.

    Returns:
        Number of this process, of which 0 logs and saves, and how many there are.

    Raises:
        ValueError: The device is not the GPU that belongs to this process.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return 0, 1
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    cuda = device.startswith("cuda")
    if cuda and device != f"cuda:{local_rank}":
        raise ValueError(
            f"--device is {device}, but this is process {local_rank} of its machine; leave "
            "--device out, then each process takes its own GPU"
        )
    # Environments are built by now, on some machines minutes later than on others. All wait here,
    # so that the short limit below is one of collectives alone.
    store, rank, world_size = next(iter(rendezvous("env://", timeout=START_TIMEOUT)))
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        # torchrun's own store outlives its workers: after a restart it still holds their addresses.
        store = PrefixStore(f"attempt_{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)
    store.set(f"built/{rank}", "1")
    store.wait([f"built/{other}" for other in range(world_size)], START_TIMEOUT)
    if cuda:
        torch.cuda.set_device(local_rank)
    torch.distributed.init_process_group(
        "nccl" if cuda else "gloo",
        store=store,
        rank=rank,
        world_size=world_size,
        timeout=COLLECTIVE_TIMEOUT,
    )
    return rank, world_size


def watch_iteration() -> None:
    """Print every thread's stack on stderr if this is not called again within ``REPORT_AFTER_S``.

    Of a run that hangs, the process whose main thread is not in ``torch.distributed`` is the one
    that the others wait for.
    """
    # A stderr without a file, as in a notebook, cannot be written to by the watching thread.
    with contextlib.suppress(AttributeError, ValueError, io.UnsupportedOperation):
        faulthandler.dump_traceback_later(REPORT_AFTER_S, file=sys.stderr)


@contextlib.contextmanager
def ending_together(*agreed: type[BaseException]) -> Iterator[None]:
    """End this process at once when the block fails, and with it, through ``torchrun``, all others.

    The others wait in a collective that this process will never enter. Leaving the process group,
    as at a regular end, waits for them in turn: the error would be held back until the time limit,
    or for ever.
    """
    try:
        yield
    except agreed:
        raise
    except BaseException as error:
        rank = os.environ.get("RANK", "0")
        print(
            f"vd-train: process {rank} failed and ends the run; --resume goes on with it",
            file=sys.stderr,
        )
        if isinstance(error, OutputError):
            print(error, file=sys.stderr)
        else:
            traceback.print_exc()
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(1)  # no clean-up that could wait for other processes
    finally:
        faulthandler.cancel_dump_traceback_later()
