"""Train a guide for your own arm. Shown by docs/tutorials/train_a_guide.md.

Run it from the repository's root; it needs the extra [train] and takes about half a minute.
"""

# %% [markdown]
# # Train a guide
# A value network learns what is left to pay, and orders the beam by it.

# %% --8<-- [start:train]
from pathlib import Path

import numpy as np

import muxjax
from muxjax.config import load_yaml
from training.config import TrainingConfig
from training.fit_value import fit
from training.problems import Regime, random_problem

out = Path("out/tiny_value")


def train() -> None:
    """Label, and fit; the same call goes on with a training that was interrupted."""
    fit(load_yaml(TrainingConfig, Path("docs/tutorials/tiny_value.yaml")), out)


if __name__ == "__main__":  # the workers that label import this file, too
    train()
# --8<-- [end:train]


# %% --8<-- [start:compare]
def compare() -> None:
    """Narrow beams in three orders, over the certified optimum of problems not seen before."""
    robot = muxjax.load_robot("docs/tutorials/my_arm.yaml")
    regime = Regime(name="new", max_step_mm=(7,), theta_rad=(0.2, 1.2))
    rng = np.random.default_rng(1)
    problems = [random_problem(robot, regime, rng) for _ in range(20)]
    optima = [muxjax.plan(robot, problem).cost for problem in problems]
    ways = {
        "no guide": {"method": "beamstep", "heuristic": "none"},
        "count": {"method": "beamstep", "heuristic": "count"},
        "trained": {"method": "learned", "checkpoint": str(out / "best.value")},
    }
    for width in [1, 4]:
        for name, options in ways.items():
            costs = [muxjax.plan(robot, p, width=width, **options).cost for p in problems]
            over = 100 * (np.array(costs) / optima - 1)
            print(f"width {width}, {name}: {over.mean():.2f} % over the optimum on average")


if __name__ == "__main__":
    compare()
# --8<-- [end:compare]
