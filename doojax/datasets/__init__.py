"""Data sets on disk: written shard by shard, resumable, checksummed; read by slice or in batches."""

from doojax.datasets.manifest import Field as Field
from doojax.datasets.store import Dataset as Dataset
from doojax.datasets.writer import DatasetWriter as DatasetWriter
