"""Labels, and the training of the value network: what is exact, what resumes, what is refused."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest

import muxjax
from muxjax.config import ConfigError, load_yaml
from muxjax.planning import plan
from muxjax.planning.bounds import bound_of
from muxjax.planning.checkpoint import load_value
from muxjax.planning.lattice import Lattice
from muxjax.planning.value import context_of
from training.compare import CompareConfig, Options, Record, drawn_problems, front, gaps, main
from training.config import TrainingConfig
from training.dataset import bounded_decisions, decisions_of, load_decisions, make_shards
from training.fit_value import fit
from training.problems import Regime, random_problem, read_problems, write_problems

FULL = Regime(name="full", problems=2, decisions=12, bent=0.5, underway=0.5, spread=0.3)
CONFIG = TrainingConfig(
    schema="muxjax/training/1",
    robot="muxarm",
    regimes=(FULL,),
    hidden=(8,),
    epochs=4,
    batch=8,
    shard=1,
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two shards of labelled decisions."""
    folder = tmp_path_factory.mktemp("data")
    make_shards(folder, "muxarm", CONFIG.regimes, seed=0, width=64, workers=1, shard=1)
    return folder


@pytest.mark.parametrize("max_step_mm", [None, 30])
def test_labels_are_the_optimum_less_the_step(muxarm, max_step_mm):
    regime = FULL.model_copy(update={"max_step_mm": (max_step_mm,)})
    rng = np.random.default_rng(5)
    problem = random_problem(muxarm, regime, rng)
    found = decisions_of(muxarm, problem, regime, width=8, net=None, rng=rng)
    scale = float(context_of(Lattice(muxarm, problem)).scale)
    assert found.step[0, 0] + found.to_go[0, 0] == pytest.approx(
        plan(muxarm, problem).cost / scale, rel=1e-6
    )
    assert (found.bound <= found.to_go + 1e-6)[found.labelled].all()
    best = np.where(found.labelled, found.step + found.to_go, np.inf)
    assert (best[:, 0] <= best.min(axis=1) + 1e-6).all()


def test_labels_by_search_are_what_is_left_of_the_plan(muxarm):
    regime = Regime(name="fine", labels="search", decisions=100, max_step_mm=(20,))
    rng = np.random.default_rng(5)
    problem = random_problem(muxarm, regime, rng)
    found = decisions_of(muxarm, problem, regime, width=8, net=None, rng=rng)
    scale = float(context_of(Lattice(muxarm, problem)).scale)
    cost = plan(muxarm, problem, "beamstep", width=8).cost
    assert found.labelled.sum(axis=1).tolist() == [1] * len(found.bound)
    assert found.step[0, 0] + found.to_go[0, 0] == pytest.approx(cost / scale, rel=1e-6)
    np.testing.assert_allclose(
        found.to_go[:-1, 0], (found.step + found.to_go)[1:, 0], rtol=1e-5, atol=1e-6
    )


def test_labels_by_the_bound_are_the_bound(muxarm):
    regime = Regime(name="fine", labels="bound", decisions=40, max_step_mm=(10,), bent=1.0)
    rng = np.random.default_rng(5)
    problem = random_problem(muxarm, regime, rng)
    lattice = Lattice(muxarm, problem)
    rows = list(bounded_decisions(lattice, 40, np.random.default_rng(1)))
    assert len(rows) == 40
    bound = bound_of(lattice)
    for choices, here in rows:
        possible, _ = lattice.expand(here[None])
        assert len(choices.stop) == possible.sum()
        np.testing.assert_array_equal(choices.to_go, bound(here - choices.moves, choices.stop))
    found = decisions_of(muxarm, problem, regime, width=8, net=None, rng=rng)
    assert found.labelled[found.exists].all()
    assert (found.bound <= found.to_go + 1e-6)[found.labelled].all()


def test_the_same_seed_gives_the_same_data(data, tmp_path):
    make_shards(tmp_path, "muxarm", CONFIG.regimes, seed=0, width=64, workers=1, shard=1)
    one, two = load_decisions(data), load_decisions(tmp_path)
    for left, right in zip(one, two, strict=True):
        np.testing.assert_array_equal(left, right)


def test_data_of_another_kind_and_altered_shards_are_refused(data, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(data, folder)
    with pytest.raises(ValueError, match="another seed"):
        make_shards(folder, "muxarm", CONFIG.regimes, seed=1, width=64, workers=1, shard=1)
    shard = next(folder.glob("full_*.npz"))
    shard.write_bytes(shard.read_bytes()[:-50])
    with pytest.raises(ValueError, match="missing or altered"):
        load_decisions(folder)
    with pytest.raises(ValueError, match="no complete data"):
        load_decisions(tmp_path)


def test_an_interrupted_training_comes_to_the_same_curve(data, tmp_path, monkeypatch, muxarm):
    whole = fit(CONFIG, tmp_path / "whole", data)
    from training import fit_value

    class StoppedError(Exception):
        pass

    epoch = fit_value._Trainer._epoch

    def dies(self, progress, *rest):
        if int(progress.epoch) == 2:
            raise StoppedError
        return epoch(self, progress, *rest)

    monkeypatch.setattr(fit_value._Trainer, "_epoch", dies)
    with pytest.raises(StoppedError):
        fit(CONFIG, tmp_path / "parts", data)
    monkeypatch.undo()
    again = fit(CONFIG, tmp_path / "parts", data)
    curves = [(tmp_path / name / "curve.json").read_text() for name in ("whole", "parts")]
    assert curves[0] == curves[1]
    assert len(json.loads(curves[0])) == 4
    for left, right in zip(whole.weights, again.weights, strict=True):
        np.testing.assert_array_equal(left, right)
    kept, header = load_value(tmp_path / "parts" / "best.value", muxarm)
    np.testing.assert_array_equal(kept.weights[0], again.weights[0])
    assert header["about"]["config"]["seed"] == 0
    with pytest.raises(ConfigError, match="another configuration"):
        fit(CONFIG.model_copy(update={"seed": 1}), tmp_path / "parts", data)


def test_training_lowers_the_loss(data, tmp_path):
    config = CONFIG.model_copy(update={"epochs": 60, "patience": 60, "learning_rate": 0.02})
    fit(config, tmp_path, data)
    curve = json.loads((tmp_path / "curve.json").read_text())
    assert curve[-1]["train"] < 0.7 * curve[0]["train"]


def test_wrong_configurations_name_the_field(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("schema: muxjax/training/1\nrobot: muxarm\nregimes: []\n")
    with pytest.raises(ConfigError, match="regimes"):
        load_yaml(TrainingConfig, path)
    path.write_text(
        "schema: muxjax/training/1\nrobot: muxarm\nregimes: [{name: a, max_step_mm: [-1]}]\n"
    )
    with pytest.raises(ConfigError, match=r"max_step_mm.*greater than 0, found -1"):
        load_yaml(TrainingConfig, path)
    with pytest.raises(ValueError, match="theta_rad must not fall"):
        Regime(name="a", theta_rad=(1.0, 0.5))


def test_the_shipped_configurations_are_valid():
    folder = muxjax.config.data_folder("configs") / "training"
    assert load_yaml(TrainingConfig, folder / "value.yaml").rounds > 0
    assert load_yaml(CompareConfig, folder / "compare.yaml").pairs


def test_the_comparison_keeps_its_records(tmp_path, muxarm):
    config = tmp_path / "compare.yaml"
    config.write_text(
        "schema: muxjax/compare/1\nrobot: muxarm\nseed: 1\nproblems: own.json\n"
        "regimes: [{name: few, problems: 2}]\nwidths: {count: [1, 4]}\n"
        "baselines: [greedy]\nexact_gib: 1\npairs: [[count 4, greedy]]\n"
    )
    options = Options(config=config, out=tmp_path / "out")
    main(Options(config=config, draw=True))
    main(options)
    records = json.loads((tmp_path / "out" / "few_001.json").read_text())
    by_method = {r["method"]: r for r in records}
    assert set(by_method) == {"exact", "greedy", "count 1", "count 4"}
    loaded = load_yaml(CompareConfig, config)
    problem = drawn_problems(muxarm, loaded)["few"][1]
    assert by_method["exact"]["cost"] == plan(muxarm, problem).cost
    assert by_method["exact"]["bound"] <= by_method["count 4"]["cost"] * (1 + 1e-12)
    before = (tmp_path / "out" / "report.md").read_text()
    main(options)  # nothing is measured again
    assert (tmp_path / "out" / "report.md").read_text() == before
    assert re.search(r"\| \**exact\** \| 100 \| 0\.00 \(0\.00\)", before)


def test_the_shipped_problems_are_those_of_their_seed(muxarm):
    folder = muxjax.config.data_folder("configs") / "training"
    for path in sorted(folder.glob("compare*.yaml")):
        config = load_yaml(CompareConfig, path)
        robot = muxjax.load_robot(config.robot)
        kept = read_problems(folder / config.problems, robot)
        assert list(kept) == [regime.name for regime in config.regimes]
        for name, problems in drawn_problems(robot, config).items():
            assert len(problems) == len(kept[name])
            for ours, theirs in zip(problems, kept[name], strict=True):
                np.testing.assert_allclose(ours.target, theirs.target, atol=1e-12)
                np.testing.assert_allclose(ours.start, theirs.start, atol=1e-12)
                assert ours.servos == theirs.servos
                assert ours.max_step == theirs.max_step
                assert ours.cost_weights == pytest.approx(theirs.cost_weights)
                assert (ours.world is None) == (theirs.world is None)


def test_files_of_problems_are_checked(tmp_path, muxarm):
    path = tmp_path / "own.json"
    problem = random_problem(muxarm, FULL, np.random.default_rng(0))
    write_problems(path, muxarm, {"few": [problem]})
    (kept,) = read_problems(path, muxarm)["few"]
    np.testing.assert_array_equal(kept.target, problem.target)
    assert plan(muxarm, kept).cost == plan(muxarm, problem).cost
    with pytest.raises(ConfigError, match="another robot"):
        read_problems(path, muxjax.load_robot("penta"))
    path.write_text(path.read_text()[:-20])
    with pytest.raises(ConfigError, match="is no file of problems"):
        read_problems(path, muxarm)
    with pytest.raises(ConfigError, match="is no file of problems"):
        read_problems(tmp_path / "none.json", muxarm)


def record_of(number: int, method: str, cost: float, total_ms: float) -> Record:
    """A record in which only these matter."""
    return Record("a", number, method, "", cost, 0.0, 1, 0.0, total_ms, 0.0, 1.0, 1, 0.0)


def test_the_front_holds_what_no_other_dominates():
    records = [
        record_of(0, "best", 1.0, 90.0),
        record_of(1, "best", 2.0, 110.0),
        record_of(0, "quick", 1.1, 1.0),
        record_of(1, "quick", 2.2, 1.0),
        record_of(0, "late", 1.1, 2.0),
        record_of(1, "late", 2.2, 2.0),
        record_of(0, "partial", 1.0, 0.5),
        record_of(1, "partial", np.inf, 0.5),
    ]
    np.testing.assert_allclose(gaps(records)["quick"], [10.0, 10.0])
    np.testing.assert_allclose(gaps(records)["partial"], [0.0])
    assert front(records) == ["best", "quick"]
