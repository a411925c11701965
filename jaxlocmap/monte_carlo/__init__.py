"""The map over runs: in chunks, over all devices of all processes, with a checkpoint on disk. It knows no robot.

- Devices. Every core is a JAX device of its own (`use_all_cores`). The processes of a cluster share the runs
  (`hosts.join`: Slurm, Kubernetes and MPI are recognised), and the first one writes the report. Whoever reaches the
  coordinator's port can join, so let that be in a network of your own; given as a number (127.0.0.1:1234), it listens
  at that address alone. When a process dies, JAX aborts the others and shows a C++ stack; the runs finished by then are
  kept.
- Randomness. Run i depends on the seed and on i alone. A device adds up a chunk of runs in the precision of the filter,
  the host adds up the chunks in float64 and in order: with the same chunk, one device, two devices and two processes
  give the same result to the last bit on the same kind of processor; another chunk changes the last digits of the
  filter's precision.
- Memory grows with the chunk, which is chosen from the shapes, and not with the runs.
- Interruptions. With a `checkpoint.Checkpoint` finished runs are kept in a folder. After Ctrl-C, a crash or a power cut
  the same call goes on and gives the result of an uninterrupted one; a folder that belongs to other settings or another
  version is refused, with the difference named.

On a CPU most of the speed hangs on an experimental option of XLA, which makes one kernel of those that share their
inputs: `hosts.merge_kernels()`, called before JAX starts. It is for processes that simulate and filter; derivatives can
make the compiler abort.
"""

from jaxlocmap.monte_carlo.hosts import use_all_cores
from jaxlocmap.monte_carlo.run import Result, monte_carlo

__all__ = ["Result", "monte_carlo", "use_all_cores"]
