"""TensorBoard's curves of several trials: points are appended to one event file a trial, which is open only meanwhile."""

import os
import socket
import time

from tensorboard.compat.proto import event_pb2, summary_pb2, types_pb2
from tensorboard.plugins.text.metadata import create_summary_metadata
from tensorboard.summary.writer.record_writer import RecordWriter


class Curves:
    """One event file in each trial's directory; hundreds of trials need no more than one open file."""

    def __init__(self, directories, text, purge=None):
        """text: shown beside the curves; purge [num_trials]: TensorBoard forgets what it had after this many steps."""
        name = f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}.{os.getpid()}"
        self.paths, self.waiting = [directory / name for directory in directories], [[] for _ in directories]
        for k, directory in enumerate(directories):
            directory.mkdir(parents=True, exist_ok=True)
            self._append(k, 0, file_version="brain.Event:2")
            if purge is None:
                value = summary_pb2.Summary.Value(tag="arguments", metadata=create_summary_metadata("", None))
                value.tensor.dtype = types_pb2.DT_STRING
                value.tensor.string_val.append(text.encode(errors="backslashreplace"))
                self._append(k, 0, summary=summary_pb2.Summary(value=[value]))
            else:
                log = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
                self._append(k, int(purge[k]) + 1, session_log=log)

    def add(self, points, steps):
        """Keep one point of every curve, {tag: [num_trials]}, at the steps [num_trials], and write what has gathered."""
        for k, step in enumerate(steps):
            values = [summary_pb2.Summary.Value(tag=tag, simple_value=float(column[k])) for tag, column in points.items()]
            self._append(k, int(step), summary=summary_pb2.Summary(value=values))
        self.flush()

    def flush(self):
        """Write what has gathered."""
        for path, events in zip(self.paths, self.waiting, strict=True):
            if events:
                with path.open("ab") as file:
                    writer = RecordWriter(file)
                    for event in events:
                        writer.write(event.SerializeToString())
                events.clear()

    def _append(self, k, step, **contents):
        self.waiting[k].append(event_pb2.Event(wall_time=time.time(), step=step, **contents))
