"""Side-by-side measurements; not collected by pytest. `python -m tests.benchmarks.kinematics`."""
