"""Train how far the observer trusts its wheels; writes ``trust.npz``.

The filter of ``wlr_gym.perception.observer`` is written again in torch, for a batch, and differentiated: the loss is
its own negative log-likelihood of the true velocity, so that errors and sigmas are learned together. Runs are simulated ones of
seeds that the accuracy is not measured with, all on the Gibbs-Appell plant; camera and optical flow come and go. What does not
depend on the estimate (how wheels roll, loads, tractions, forces) is taken from the compiled observer.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import wlr_gym.perception.observer as package
from studies.observer.runs import DRIVEN, PERIOD, PLAYED, Runs, play, simulate
from wlr_gym.perception.observer import SlipObserver
from wlr_gym.perception.observer.trust import CLUES, CLUES_ALIKE, MEMORY, OUTPUTS
from wlr_gym.robot import load_robot

ROBOT = load_robot("nominal")
SEEDS = (77, 78)
COUNT, TICKS, CHUNK, BATCH = 128, 500, 50, 208
ACCEL_NOISE = ROBOT.sensors.imu.accel_noise
CAMERA_NOISE, FLOW_NOISE, FLOW_SCALE = ROBOT.sensors.camera.position_noise, 0.014, 0.03
#: What is taken from the compiled observer's state of each step.
TAKEN = ("rolling", "load", "traction", "force", "slope", "turned", "yaw_rate", "shaken", "legs", "inclined", "guess")
#: Noises that are learnt: of the leak its wander, with the legs, with turning; of the velocity; at the start.
NOISES = ("leak_wander", "leak_legs", "leak_turn", "alias", "velocity_legs", "start_speed", "start_leak")
Batch = dict[str, Tensor]


def gather_runs() -> Batch:
    """Return all training runs: (T + 1, N, ...) each."""
    parts: list[dict[str, np.ndarray]] = []
    for seed in SEEDS:
        for floor, drive in DRIVEN:
            parts.append(_prepared(simulate("gibbs_appell", floor, drive, COUNT, TICKS * PERIOD, seed=seed)))
        for policy, floor in PLAYED:
            parts.append(_prepared(play(policy, floor, COUNT, TICKS * PERIOD, seed=seed)))
    return {name: torch.from_numpy(np.concatenate([part[name] for part in parts], axis=1)) for name in parts[0]}


def _prepared(runs: Runs) -> dict[str, np.ndarray]:
    count = runs.sensors.shape[1]
    observer, everyone = SlipObserver(runs.robot, PERIOD, count, False), np.ones(count, bool)
    kept: dict[str, list[np.ndarray]] = {name: [] for name in (*TAKEN, "heading", "left", "leak")}
    for tick, readings in enumerate(runs.sensors):
        (observer.update if tick else observer.reset)(everyone, readings)
        for name, values in kept.items():
            values.append(observer._states[name].astype(np.float32))
    out = {name: np.array(values) for name, values in kept.items()}
    velocity = runs.true("linear_velocity_in_body")
    ahead, aside = ((velocity * out.pop(name)).sum(-1) for name in ("heading", "left"))
    out["velocity"] = np.stack([ahead, aside], axis=-1).astype(np.float32)
    out["age"], out["is_new"] = (runs.sensed(name).astype(np.float32) for name in ("camera_age", "camera_is_new"))
    return out


def squash(x: Tensor) -> Tensor:
    x = x.clamp(-3.0, 3.0)
    return x * (27.0 + x * x) / (27.0 + 9.0 * x * x)


def size(x: Tensor, least: float, middle: float) -> Tensor:
    return 0.5 * (torch.log(x.abs() + least) + middle)


class Trust(nn.Module):
    """The network of ``trust.py`` and the noises learned with it; inputs: clues, clues alike, memory, partner's, mean."""

    def __init__(self) -> None:
        super().__init__()
        seen = CLUES + CLUES_ALIKE
        self.gate, self.output = nn.Linear(seen + 3 * MEMORY, 2 * MEMORY), nn.Linear(MEMORY + seen, OUTPUTS)
        with torch.no_grad():
            self.gate.weight.mul_(0.7)
            self.gate.bias[:MEMORY] = -2.0
            self.output.weight.mul_(0.1)
            self.output.bias[:] = torch.tensor([6.0, 6.0, -5.0, 0.0, 0.0])
        self.noise = nn.Parameter(torch.log(torch.tensor([0.01, 0.02, 2.0, 0.25, 0.3, 0.05, 0.05])))

    def judge(self, clues: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        others = memory[:, [2, 3, 0, 1]], memory.mean(1, keepdim=True).expand_as(memory)
        total = self.gate(torch.cat([clues, memory, *others], -1))
        share = 0.5 + 0.5 * squash(0.5 * total[..., :MEMORY])
        memory = memory + share * (squash(total[..., MEMORY:]) - memory)
        return memory, self.output(torch.cat([memory, clues], -1))

    def arrays(self) -> dict[str, np.ndarray]:
        """What the compiled observer reads."""
        gate, output = (layer.weight.detach().numpy() for layer in (self.gate, self.output))
        seen = CLUES + CLUES_ALIKE
        noise = np.exp(self.noise.detach().numpy().astype(float))
        return {
            "gate": np.concatenate([gate[:, :CLUES], gate[:, seen : seen + 2 * MEMORY]], axis=1),
            "gate_alike": np.concatenate([gate[:, CLUES:seen], gate[:, seen + 2 * MEMORY :]], axis=1),
            "gate_bias": self.gate.bias.detach().numpy(),
            "output": np.concatenate([output[:, MEMORY : MEMORY + CLUES], output[:, :MEMORY]], axis=1),
            "output_alike": output[:, MEMORY + CLUES :],
            "output_bias": self.output.bias.detach().numpy(),
            **dict(zip(NOISES, noise, strict=True)),
        }

    def start_from(self, arrays: Any) -> None:
        """Begin with what :meth:`arrays` has returned."""
        own, alike, out = (torch.from_numpy(np.array(arrays[name])) for name in ("gate", "gate_alike", "output"))
        gate = [own[:, :CLUES], alike[:, :CLUES_ALIKE], own[:, CLUES:], alike[:, CLUES_ALIKE:]]
        output = [out[:, CLUES:], out[:, :CLUES], torch.from_numpy(np.array(arrays["output_alike"]))]
        noise = np.array([float(arrays[name]) for name in NOISES])
        with torch.no_grad():
            self.gate.weight.copy_(torch.cat(gate, 1))
            self.output.weight.copy_(torch.cat(output, 1))
            self.gate.bias.copy_(torch.from_numpy(np.array(arrays["gate_bias"])))
            self.output.bias.copy_(torch.from_numpy(np.array(arrays["output_bias"])))
            self.noise.copy_(torch.from_numpy(np.log(noise)))


def begin(d: Batch, net: Trust) -> Batch:
    """State at the reset: mean, error of the position (heading frame), covariances (p, v, l: six numbers), memories."""
    n = d["load"].shape[1]
    zero, none = torch.zeros(n, 2), torch.zeros(())
    speed, leak = torch.exp(net.noise[5:]) ** 2
    p = torch.stack([torch.tensor(1e-8), none, none, speed, none, leak]).expand(n, 2, 6)
    state = {"v": zero, "leak": d["leak"][0].clone(), "off": zero, "error": zero, "p": p, "wander": zero}
    return state | {"memory": torch.zeros(n, 4, MEMORY), "rolling": d["rolling"][0]}


def turned(a: Tensor, c: Tensor, s: Tensor) -> Tensor:
    return torch.stack([c * a[:, 0] + s * a[:, 1], c * a[:, 1] - s * a[:, 0]], -1)


def corrected(
    p: tuple[Tensor, ...], h: tuple[Any, Any, Any], noise: Tensor | float, share: Tensor | float
) -> tuple[Any, tuple[Tensor, ...]]:
    """Gains and covariance after a measurement h of (p, v, l), taken in where ``share`` is 1."""
    pp, pv, pl, vv, vl, ll = p
    cp, cv, cl = h[0] * pp + h[1] * pv + h[2] * pl, h[0] * pv + h[1] * vv + h[2] * vl, h[0] * pl + h[1] * vl + h[2] * ll
    total = h[0] * cp + h[1] * cv + h[2] * cl + noise
    kp, kv, kl = share * cp / total, share * cv / total, share * cl / total
    return (kp, kv, kl), (pp - kp * cp, pv - kp * cv, pl - kp * cl, vv - kv * cv, vl - kv * cl, ll - kl * cl)


def predict(d: Batch, i: int, state: Batch, net: Trust) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
    """Return velocity, acceleration, error of the position and covariances after the step's motion."""
    q, dt = torch.exp(net.noise), PERIOD
    acceleration = d["force"][i][:, :2] - state["leak"] - 0.5 * (d["slope"][i] + d["slope"][i - 1])
    angle = d["turned"][i]
    c, s = torch.cos(0.5 * angle), torch.sin(0.5 * angle)
    v = turned(turned(state["v"], c, s) + dt * acceleration, c, s)
    off = turned(state["off"], c * c - s * s, 2.0 * c * s) + 0.5 * dt * (state["error"] + v - d["velocity"][i])
    legs = d["legs"][i] ** 2
    leak_noise = (q[0] ** 2 + q[1] ** 2 * legs) * dt + (q[2] * d["guess"][i] * angle) ** 2
    shaken = (q[3] * d["shaken"][i]) ** 2 + q[4] ** 2 * legs
    wander = torch.exp(state["wander"])
    velocity_noise = dt * dt * (ACCEL_NOISE**2 + wander[:, 0] * shaken)
    pp, pv, pl, vv, vl, ll = state["p"].unbind(-1)
    half = 0.5 * dt * dt
    a, b = pv + dt * vv - half * vl, pl + dt * vl - half * ll
    pp = pp + dt * pv - half * pl + dt * a - half * b
    low = vl - dt * ll
    p = (pp, a - dt * b, b, vv - dt * vl - dt * low + velocity_noise[:, None], low, ll + (leak_noise * wander[:, 1])[:, None])
    return v, acceleration, off, p


def see(
    d: Batch, i: int, state: Batch, v: Tensor, acceleration: Tensor, p: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what the network sees (N, 4, ...), by how much the wheels roll faster, and their use of traction."""
    rolling, load, force = d["rolling"][i], d["load"][i], d["force"][i]
    rolls = rolling - v[:, None]
    use = d["traction"][i] / load.clamp(min=0.5)
    dx, dy = rolls.unbind(-1)
    mean = rolls.mean(1, keepdim=True)
    jump = rolling - state["rolling"] - (v - state["v"])[:, None]
    pull = acceleration + 0.5 * (d["slope"][i] + d["slope"][i - 1])
    fz = force[:, 2:].clamp(min=2.0)
    demand = torch.sqrt((pull**2).sum(-1) + 1e-9) / fz[:, 0]
    own = [
        size(dx, 1e-3, 5.0),
        size(dy, 1e-3, 5.0),
        2.0 * use.abs(),
        3.0 * use * dx / (dx.abs() + 0.01),
        10.0 * use * pull[:, :1] / fz,
    ]
    own += [load / (load.mean(1, keepdim=True) + 0.1) - 1.0, size(jump[..., 0], 1e-3, 6.0), size(jump[..., 1], 1e-3, 6.0)]
    own += [5.0 * rolling[..., 0].abs().clamp(max=0.6), size(dx - mean[..., 0], 1e-3, 5.0)]
    sigmas = (0.5 * (0.5 * torch.log(p[3]) + 5.0)).unbind(-1)
    off = 0.5 * (0.5 * torch.log((mean**2).sum(-1)[:, 0] + 1e-6) + 5.0)
    alike = [*sigmas, 3.0 * torch.sqrt(demand), d["yaw_rate"][i].abs().clamp(max=2.0), d["legs"][i].clamp(max=3.0)]
    alike += [0.5 * d["shaken"][i].clamp(max=5.0), off, d["inclined"][i]]
    return torch.stack([*own, *(value[:, None].expand_as(dx) for value in alike)], -1), rolls, use


def first_guess(v: Tensor, rolling: Tensor) -> Tensor:
    for _ in range(4):
        weight = 1.0 / torch.sqrt(((rolling - v[:, None]) ** 2).sum(-1, keepdim=True) + 0.003**2)
        v = (weight * rolling).sum(1) / weight.sum(1)
    return v


def advance(d: Batch, i: int, state: Batch, net: Trust, w: Batch) -> tuple[Batch, Tensor, Tensor]:
    """One control step; returns the state, the velocity's errors and their variances. ``w``: who has camera and flow."""
    v, acceleration, off, p = predict(d, i, state, net)
    v = first_guess(v, d["rolling"][i]) if i == 1 else v
    clues, rolls, use = see(d, i, state, v, acceleration, p)
    memory, said = net.judge(clues, state["memory"])
    precision = torch.exp(said[..., :2].clamp(0.0, 14.5))
    lead = torch.exp(said[..., 2].clamp(-8.0, 0.0)) * use.clamp(-1.0, 1.0)
    total = precision.sum(1)
    innovation = (precision * torch.stack([rolls[..., 0] - lead, rolls[..., 1]], -1)).sum(1) / total
    noise = 1.0 / total + 0.0005**2 + (0.0025 * d["rolling"][i][..., 0].mean(1, keepdim=True)) ** 2
    gain, p = corrected(p, (0.0, 1.0, 0.0), noise, 1.0)
    off, v, leak = off + gain[0] * innovation, v + gain[1] * innovation, state["leak"] + gain[2] * innovation
    true = d["velocity"][i]
    age = d["age"][i][:, None]
    share = (((i >= w["camera_on"]) & (i < w["camera_off"])) * d["is_new"][i])[:, None]
    gain, p = corrected(p, (1.0, -age, -0.5 * age * age), CAMERA_NOISE**2, share)
    innovation = CAMERA_NOISE * w["camera_noise"][i] - off + age * (v - true)
    off, v, leak = off + gain[0] * innovation, v + gain[1] * innovation, leak + gain[2] * innovation
    share = ((i >= w["flow_on"]) & (i < w["flow_off"])).float()[:, None]
    gain, p = corrected(p, (0.0, 1.0, 0.0), FLOW_NOISE**2 + (5.0 * FLOW_SCALE * true) ** 2, share)
    innovation = true - v + share * (FLOW_NOISE * w["flow_noise"][i] + w["flow_scale"][:, None] * true)
    off, v, leak = off + gain[0] * innovation, v + gain[1] * innovation, leak + gain[2] * innovation
    out = {"v": v, "leak": leak, "off": off, "error": v - true, "p": torch.stack(p, -1), "memory": memory}
    out |= {"wander": said[..., 3:].mean(1).clamp(-4.0, 4.0), "rolling": d["rolling"][i]}
    return out, v - true, p[3]


def drawn_sensors(rng: np.random.Generator) -> Batch:
    """Camera for 30 %, flow for 20 % of the robots; some get it late, some lose it."""
    out = {"camera_noise": torch.randn(TICKS + 1, BATCH, 2), "flow_noise": torch.randn(TICKS + 1, BATCH, 2)}
    out["flow_scale"] = FLOW_SCALE * torch.randn(BATCH)
    for name, share in (("camera", 0.3), ("flow", 0.2)):
        late, lost = rng.integers(0, 400, BATCH) * (rng.random(BATCH) < 0.3), rng.integers(100, TICKS, BATCH)
        has = rng.random(BATCH) < share
        out[f"{name}_on"] = torch.from_numpy(np.where(has, late, TICKS + 1))
        out[f"{name}_off"] = torch.from_numpy(np.where(rng.random(BATCH) < 0.3, lost, TICKS + 1))
    return out


def loss_of(error: Tensor, variance: Tensor) -> Tensor:
    """Negative log-likelihood, from 16 sigma on linear; large errors count beyond that."""
    n = error.abs() / torch.sqrt(variance)
    likelihood = torch.where(n < 16.0, 0.5 * n * n, 16.0 * n - 128.0) + 0.5 * torch.log(variance)
    return likelihood.mean() + 0.2 * (torch.sqrt(1.0 + (error / 0.01) ** 2) - 1.0).mean()


def train(runs: Batch, net: Trust, minutes: float) -> None:
    rng, start = np.random.default_rng(0), time.monotonic()
    torch.manual_seed(0)
    optimiser = torch.optim.Adam(net.parameters(), lr=5e-3)
    while (share := (time.monotonic() - start) / (60.0 * minutes)) < 1.0:
        chosen = torch.from_numpy(rng.permutation(runs["load"].shape[1])[:BATCH])
        d, sensors = {name: values[:, chosen] for name, values in runs.items()}, drawn_sensors(rng)
        state, losses = begin(d, net), []
        for first in range(1, TICKS if rng.random() < 0.5 else 200, CHUNK):
            state = {name: values.detach() if first > 1 else values for name, values in state.items()}
            loss = torch.zeros(())
            for i in range(first, first + CHUNK):
                state, error, variance = advance(d, i, state, net, sensors)
                loss = loss + (1.0 if i > 12 else 0.2) * loss_of(error, variance) / CHUNK
            optimiser.zero_grad()
            loss.backward()
            norm = nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.param_groups[0]["lr"] = 5e-3 * (0.5 + 0.5 * math.cos(math.pi * share) + 0.02)
            if torch.isfinite(norm):
                optimiser.step()
            losses.append(loss.item())
        print(f"{time.monotonic() - start:6.0f} s  loss {np.mean(losses):.3f}", flush=True)


def train_network(minutes: float, start: Path | None = None) -> None:
    """Train from random weights, or from a file of weights; replaces the package's own file."""
    torch.set_num_threads(1)
    net, runs = Trust(), gather_runs()
    if start is not None:
        net.start_from(np.load(start))
    train(runs, net, minutes)
    arrays: dict[str, Any] = net.arrays()
    np.savez(Path(package.__file__).parent / "trust.npz", **arrays)
