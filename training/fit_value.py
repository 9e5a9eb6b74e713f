"""Train the value network.

    python -m training.fit_value --config configs/training/value.yaml --out out/value

The data come first (training.dataset), then epochs of AdamW on two losses: the cost to go of every
labelled action, and the order among a decision's actions. Rounds of self-play then label finer
problems by the beam in the network's own order, and training goes on with these too. Everything is
kept in the output folder: data, the state of the optimiser after every epoch, the curve, and the
best network as a checkpoint. The same command goes on where it stopped, to the same curve.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from torch.utils.tensorboard import SummaryWriter

import muxjax
from muxjax.config import load_yaml, replacing
from muxjax.planning.checkpoint import save_value
from muxjax.planning.value import ValueNet, n_features, turn_by_a_tendon, value_net
from muxjax.precision import matmul
from muxjax.robot import Robot
from training.config import TrainingConfig, keep_config
from training.dataset import (
    Decisions,
    commit,
    label_seconds,
    load_decisions,
    make_shards,
    shards_of,
)

_HUBER = 0.05  # error [scale] beyond which the value's loss is linear


class Progress(NamedTuple):
    """All that training goes on from."""

    net: ValueNet
    optimiser: Any
    best: ValueNet
    epoch: Any  # of all stages together
    stage: Any  # 0, then the rounds of self-play
    stage_epoch: Any
    lowest: Any  # validation loss of the best net in this stage
    since: Any  # epochs since then


@dataclass
class Options:
    """What the command line may change.

    Attributes:
        config: The YAML file of the training.
        out: Folder for everything.
        seed: Another seed than the file's.
        symmetry: Whether to turn decisions, whatever the file says.
        ranking: Another weight of the order's loss.
        rounds: Another number of rounds of self-play.
        budget_s: Another limit on seconds.
        data: Folder of the data, if not below ``out``: several trainings may share it.
    """

    config: Path = Path("configs/training/value.yaml")
    out: Path = Path("out/value")
    seed: int | None = None
    symmetry: bool | None = None
    ranking: float | None = None
    rounds: int | None = None
    budget_s: float | None = None
    data: Path | None = None


def main(options: Options) -> None:
    """Train as the file and the options say."""
    names = ("seed", "symmetry", "ranking", "rounds", "budget_s")
    given = {name: getattr(options, name) for name in names}
    config = load_yaml(TrainingConfig, options.config)
    config = config.model_copy(update={k: v for k, v in given.items() if v is not None})
    fit(config, options.out, options.data)


def fit(config: TrainingConfig, out: Path, data: Path | None = None) -> ValueNet:
    """Train, or go on with a training in the folder, and write ``best.value`` there.

    Raises:
        ConfigError: The folder holds a training of another configuration.
    """
    out.mkdir(parents=True, exist_ok=True)
    keep_config(config, out)
    robot = muxjax.load_robot(config.robot)
    began, cpu = time.monotonic(), time.process_time()
    data = data or out / "data"
    make_shards(
        data,
        config.robot,
        config.regimes,
        seed=config.data_seed,
        width=config.width,
        shard=config.shard,
    )
    trainer = _Trainer(config, robot, out)
    progress = trainer.restored()
    folders = [data]
    for stage in range(config.rounds + 1):
        if stage > 0:
            folders.append(out / f"round{stage}")
        if stage > int(progress.stage):
            net, seed = progress.best, config.seed + 1000 * stage
            make_shards(
                folders[-1],
                config.robot,
                config.self_play,
                seed=seed,
                width=config.width,
                net=net,
                shard=config.shard,
            )
            progress = trainer.next_stage(progress)
        if stage == int(progress.stage):
            progress = trainer.run(progress, folders, began)
        if config.budget_s is not None and time.monotonic() - began > config.budget_s:
            break
    about = {
        "config": config.model_dump(mode="json", by_alias=True),
        "commit": commit(),
        "curve": json.loads((out / "curve.json").read_text())[-1],
        "cpu_s": {
            "labels": round(sum(label_seconds(folder) for folder in folders)),
            "training": round(time.process_time() - cpu),
        },
    }
    save_value(out / "best.value", progress.best, robot, about)
    print(f"{out / 'best.value'}: {about['curve']}")
    trainer.writer.close()
    return progress.best


class _Trainer:
    """The network, its optimiser and their files."""

    def __init__(self, config: TrainingConfig, robot: Robot, out: Path) -> None:
        self.config, self.out = config, out
        turn = turn_by_a_tendon(robot)
        count = robot.tendons_per_segment if config.symmetry else 1
        self.turns = [np.linalg.matrix_power(turn, k).astype(np.float32) for k in range(count)]
        self.sizes = (n_features(robot), *config.hidden, 1)
        self.writer = SummaryWriter(str(out / "tensorboard"))
        self.curve: list[dict[str, float]] = []

    def fresh(self) -> Progress:
        """Before the first epoch."""
        net = value_net(self.sizes, jax.random.key(self.config.seed))
        zero = np.zeros((), np.int64)
        state = _optimiser(self.config, 1).init(net)
        return Progress(net, state, net, zero, zero, zero, np.full((), np.inf), zero)

    def restored(self) -> Progress:
        """As it was after the last epoch in the folder."""
        path = self.out / "progress.eqx"
        if not path.is_file():
            return self.fresh()
        self.curve = json.loads((self.out / "curve.json").read_text())
        found: Progress = eqx.tree_deserialise_leaves(path, self.fresh())
        self.curve = self.curve[: int(found.epoch)]
        return found

    def next_stage(self, progress: Progress) -> Progress:
        """The best network, a new optimiser, one more stage."""
        begun = self.fresh()
        return begun._replace(
            net=progress.best,
            best=progress.best,
            optimiser=_optimiser(self.config, 1).init(progress.best),
            epoch=progress.epoch,
            stage=progress.stage + 1,
        )

    def run(self, progress: Progress, folders: list[Path], began: float) -> Progress:
        """Epochs until the loss on decisions held back no longer falls."""
        parts = [_split(folder) for folder in folders]
        train, held = (
            Decisions(*(np.concatenate(column) for column in zip(*side, strict=True)))
            for side in zip(*parts, strict=True)
        )
        batches = max(1, len(train.bound) // self.config.batch)
        optimiser = _optimiser(self.config, batches * self.config.epochs)
        while progress.stage_epoch < self.config.epochs and progress.since < self.config.patience:
            if self.config.budget_s is not None and time.monotonic() - began > self.config.budget_s:
                break
            progress = self._epoch(progress, train, held, optimiser, batches)
        return progress

    def _epoch(
        self, progress: Progress, train: Decisions, held: Decisions, optimiser: Any, batches: int
    ) -> Progress:
        began = time.monotonic()
        rng = np.random.default_rng([self.config.seed, int(progress.epoch)])
        order = rng.permutation(len(train.bound))
        net, state = progress.net, progress.optimiser
        losses = []
        for rows in np.array_split(order, batches):
            chosen = _sharded(Decisions(*(x[rows[: len(order) // batches]] for x in train)))
            turn = self.turns[rng.integers(len(self.turns))]
            net, state, loss = _step(self._hyper, optimiser, net, state, chosen, turn)
            losses.append(loss)  # not read here: the device would have to be waited for
        total = sum(float(loss) for loss in losses)
        scores = {k: float(v) for k, v in self._scores(net, held).items()}
        improved = scores["loss"] < float(progress.lowest)
        epoch = int(progress.epoch) + 1
        line = {"epoch": epoch, "stage": int(progress.stage), "train": total / batches, **scores}
        self.curve.append(line)
        for name, value in line.items():
            self.writer.add_scalar(f"value/{name}", value, epoch)
        seconds = time.monotonic() - began
        shown = ", ".join(f"{k} {v:.4f}" for k, v in line.items() if k not in ("epoch", "stage"))
        print(f"stage {line['stage']}, epoch {epoch}: {shown}; {seconds:.1f} s", flush=True)
        after = Progress(
            net,
            state,
            net if improved else progress.best,
            progress.epoch + 1,
            progress.stage,
            progress.stage_epoch + 1,
            np.asarray(min(scores["loss"], float(progress.lowest))),
            np.where(improved, 0, progress.since + 1),
        )
        (self.out / "curve.json").write_text(json.dumps(self.curve, indent=0))
        with replacing(self.out / "progress.eqx") as part:
            eqx.tree_serialise_leaves(part, after)
        return after

    @property
    def _hyper(self) -> tuple[float, float]:
        return self.config.ranking, self.config.temperature

    def _scores(self, net: ValueNet, held: Decisions) -> dict[str, Any]:
        chunks = range(0, len(held.bound), 4096)
        parts = [
            _judged(self._hyper, net, Decisions(*(x[i : i + 4096] for x in held))) for i in chunks
        ]
        weights = np.array([min(4096, len(held.bound) - i) for i in chunks])
        return {
            name: np.average([float(part[name]) for part in parts], weights=weights)
            for name in parts[0]
        }


def _split(folder: Path) -> tuple[Decisions, Decisions]:
    """Training decisions, and those of each regime's last shard, which are of other targets."""
    names = sorted(shards_of(folder))
    last = {name.rsplit("_", 1)[0]: name for name in names}
    held = set(last.values())
    if len(held) == len(names):
        raise ValueError(f"{folder}: needs two shards of a regime at least, one is held back")
    return (
        load_decisions(folder, [n for n in names if n not in held]),
        load_decisions(folder, sorted(held)),
    )


def _sharded(decisions: Decisions) -> Decisions:
    """Spread over the devices, where there are several and they divide the batch."""
    devices = jax.devices()
    if len(devices) == 1 or len(decisions.bound) % len(devices):
        return decisions
    mesh = jax.sharding.Mesh(np.array(devices), ("batch",))
    rows = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("batch"))
    return Decisions(*(jax.device_put(x, rows) for x in decisions))


def _optimiser(config: TrainingConfig, steps: int) -> Any:
    rate = optax.cosine_decay_schedule(config.learning_rate, steps, alpha=0.01)
    return optax.adamw(rate, weight_decay=config.weight_decay)


def _losses(
    hyper: tuple[float, float], net: ValueNet, decisions: Decisions
) -> dict[str, jax.Array]:
    """Losses, and the mean regret of the action that the network takes for the best."""
    ranking, temperature = hyper
    rows, actions = decisions.bound.shape
    inputs = jnp.asarray(decisions.features).reshape(rows * actions, -1)
    correction = jnp.where(decisions.arrived, 0.0, net(inputs).reshape(rows, actions))
    judged = decisions.labelled & ~decisions.arrived
    error = correction - (decisions.to_go - decisions.bound)
    value = jnp.sum(jnp.where(judged, optax.huber_loss(error, delta=_HUBER), 0.0))
    value = value / jnp.maximum(jnp.sum(judged), 1) / _HUBER
    through = decisions.step + decisions.to_go
    guessed = decisions.step + decisions.bound + correction
    wanted = jax.nn.softmax(jnp.where(decisions.labelled, -through / temperature, -jnp.inf))
    found = jax.nn.log_softmax(jnp.where(decisions.exists, -guessed / temperature, -1e9))
    rank = -jnp.mean(jnp.sum(wanted * jnp.where(decisions.exists, found, 0.0), axis=1))
    taken = jnp.argmin(jnp.where(decisions.exists, guessed, jnp.inf), axis=1)
    whole = jnp.all(decisions.labelled == decisions.exists, axis=1)
    best = jnp.min(jnp.where(decisions.labelled, through, jnp.inf), axis=1)
    regret = jnp.take_along_axis(through, taken[:, None], axis=1)[:, 0] - best
    regret = jnp.sum(jnp.where(whole, regret, 0.0)) / jnp.maximum(jnp.sum(whole), 1)
    return {"loss": value + ranking * rank, "value": value, "rank": rank, "regret": regret}


_judged = jax.jit(_losses, static_argnums=0)


@partial(jax.jit, static_argnums=(0, 1))
def _step(
    hyper: tuple[float, float],
    optimiser: Any,
    net: ValueNet,
    state: Any,
    decisions: Decisions,
    turn: Any,
) -> tuple[ValueNet, Any, Any]:
    """One step of the optimiser on decisions turned by this matrix (F, F)."""
    inputs = jnp.asarray(decisions.features, jnp.float32)
    turned = decisions._replace(features=matmul(inputs, turn.T))

    def loss(net: ValueNet) -> jax.Array:
        return _losses(hyper, net, turned)["loss"]

    value, gradient = jax.value_and_grad(loss)(net)
    update, state = optimiser.update(gradient, state, net)
    return optax.apply_updates(net, update), state, value


if __name__ == "__main__":
    main(tyro.cli(Options))
