"""What an arm and its drive did over time: of a program, or of a run's frames; MCAP files of it."""

from muxjax.recording.mcap import save_mcap
from muxjax.recording.recording import Recording, program_recording, take
from muxjax.recording.run_log import LoggedRun, logged_recording, read_log

__all__ = [
    "LoggedRun",
    "Recording",
    "logged_recording",
    "program_recording",
    "read_log",
    "save_mcap",
    "take",
]
