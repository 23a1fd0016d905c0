"""A recording read back."""

from __future__ import annotations

import numpy as np
from rerun.chunk import RrdReader


class Recorded:
    """What is in a recording, by entity."""

    def __init__(self, path):
        self.reader = RrdReader(path)
        self.chunks = [(chunk, chunk.to_record_batch()) for chunk in self.reader.stream()]
        self.entities = {chunk.entity_path for chunk, _ in self.chunks}
        self.timelines = {
            name for chunk, _ in self.chunks for name in chunk.timeline_names if not name.startswith("log_")
        }

    def static(self, entity, component):
        (value,) = [
            batch.column(component)[0].as_py()
            for chunk, batch in self.chunks
            if chunk.entity_path == entity and chunk.is_static and component in batch.schema.names
        ]
        return np.array(value)

    def rows(self, entity, component, timeline="pose"):
        """Row by row: where on the timeline, and the instances there."""
        (batch,) = [
            batch
            for chunk, batch in self.chunks
            if chunk.entity_path == entity and not chunk.is_static and component in batch.schema.names
        ]
        values = [np.array(row.as_py()) for row in batch.column(component)]
        at = batch.column(timeline).to_pylist()
        if timeline == "pose":
            at = [number - 1 for number in at]  # the viewer counts poses as people do
        return dict(zip(at, values, strict=True))

    def all_rows(self, entity, component):
        """All instances, pose by pose."""
        return np.concatenate([row for row in self.rows(entity, component).values() if len(row)])
