"""Sharded jobs: inputs divided into blocks, each of which a worker turns into a shard of results.

This is for many machines, by ``--engine ray``. Its workers are processes that Ray starts, restarts
and gives blocks to; results go into tar shards, since millions of files would choke a file system.
The plain command uses the loop of ``core.runner`` in place of it, in one process or, under
``torchrun``, in several that share out the inputs (``core.processes``); it writes a file for each
result. In both, inputs go through the network in batches.

The engine deals with files and names; what a worker computes of them is a function.
"""

from depthpose.core.engine.inputs import PLAN as PLAN
from depthpose.core.engine.inputs import InputFormat as InputFormat
from depthpose.core.engine.inputs import JobInputs as JobInputs
from depthpose.core.engine.inputs import ListedInput as ListedInput
from depthpose.core.engine.inputs import LocalInput as LocalInput
from depthpose.core.engine.inputs import list_inputs as list_inputs
from depthpose.core.engine.job import ShardedJob as ShardedJob
from depthpose.core.engine.job import read_records as read_records
from depthpose.core.engine.job import read_shard as read_shard
from depthpose.core.engine.job import run_job as run_job
from depthpose.core.engine.ray_engine import RayEngine as RayEngine
from depthpose.core.engine.shards import Computation as Computation
from depthpose.core.engine.shards import ResultWriter as ResultWriter
from depthpose.core.engine.shards import ShardRecord as ShardRecord
