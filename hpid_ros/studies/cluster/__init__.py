"""Batches on the workers of a Dask scheduler, with the numbers of this machine."""

from hpid_ros.studies.cluster.client import Cluster

__all__ = ["Cluster"]
