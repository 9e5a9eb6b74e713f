"""What an arm and its drive do over time: of files of programs, plans and runs; MCAP files."""

from muxjax.recording.mcap import save_mcap
from muxjax.recording.programs import read_program
from muxjax.recording.recording import Recording, program_recording, take
from muxjax.recording.run_log import LoggedRun, logged_recording, read_log

__all__ = [
    "LoggedRun",
    "Recording",
    "logged_recording",
    "program_recording",
    "read_log",
    "read_program",
    "save_mcap",
    "take",
]
