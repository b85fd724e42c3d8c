"""A Ray cluster of several nodes on this machine. A node can be killed with all its processes, and another added."""

import os
from types import TracebackType
from typing import Any

import psutil
from ray.cluster_utils import Cluster

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")


class LocalCluster:
    """A cluster of `n_nodes` nodes with one core each, and a head without cores that survives the nodes.

    Programs on this machine connect to the head, so killing a node never disconnects them.
    """

    def __init__(self, n_nodes: int, cores_of_node: int = 1):
        self._cores = cores_of_node
        self._cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        self.nodes: list[Any] = []
        for _ in range(n_nodes):
            self.add()

    @property
    def address(self) -> str:
        """Address for `perilune-render dataset --executor ray --address`."""
        return str(self._cluster.address)

    def add(self) -> None:
        """Start a node and wait until it has joined."""
        self.nodes.append(self._cluster.add_node(num_cpus=self._cores))

    def kill(self, index: int) -> int:
        """Kill a node: its raylet and all processes below it, by SIGKILL. Returns the number of processes."""
        node = self.nodes.pop(index)
        pids = [info.process.pid for infos in node.all_processes.values() for info in infos]
        below = [process for pid in pids for process in psutil.Process(pid).children(recursive=True)]
        for pid in pids:
            psutil.Process(pid).suspend()  # otherwise a raylet would replace its killed workers
        for process in below:
            process.kill()
        self._cluster.remove_node(node, allow_graceful=False)
        return len(pids) + len(below)

    def __enter__(self) -> "LocalCluster":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._cluster.shutdown()
