"""Computes a chunk of actions again from what `rapid policy observe` wrote, with onnxruntime and numpy alone.

    python recompute.py POLICY CHUNK.npz

The arrays are named as the encoder's inputs: of a history its pictures, and which of its steps there are (1; else 0, and the
picture is zeros). Prints how far it is from the recorded chunk, in the units of the action; an error if that is more than
0.0001: another policy, another scheduler, or a processor that rounds in another way.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime


def alphas_cumprod(schedule):
    """The products of 1 - beta of the forward process (squaredcos_cap_v2: Nichol and Dhariwal, 2021)."""
    count = schedule["num_train_timesteps"]
    assert schedule["beta_schedule"] == "squaredcos_cap_v2" and schedule["type"] == "DDIM"
    assert schedule["prediction_type"] == "epsilon" and schedule["timestep_spacing"] == "leading"
    level = np.cos((np.arange(count + 1) / count + 0.008) / 1.008 * np.pi / 2) ** 2
    return np.cumprod(1 - np.minimum(1 - level[1:] / level[:-1], 0.999))


def recompute(policy, arrays):
    """The chunk [Tp, Da] in the units of the action."""
    described = json.loads((policy / "policy.json").read_text(encoding="utf-8"))
    names = [described["graphs"][graph]["file"] for graph in ("encoder", "denoiser")]
    encoder, denoiser = (onnxruntime.InferenceSession(policy / name, providers=["CPUExecutionProvider"]) for name in names)
    condition = encoder.run(None, {one.name: arrays[one.name] for one in encoder.get_inputs()})[0]
    schedule = described["scheduler"]
    alphas, clip = alphas_cumprod(schedule), schedule["clip_sample_range"] if schedule["clip_sample"] else np.inf
    stride = schedule["num_train_timesteps"] // schedule["num_inference_steps"]
    sample = arrays["noise"]
    for step in range(schedule["num_inference_steps"] - 1, -1, -1):
        at = step * stride + schedule["steps_offset"]
        inputs = {"sample": sample, "timestep": np.array([at], np.int64), "global_cond": condition}
        noise = denoiser.run(None, inputs)[0]
        now, before = alphas[at], alphas[at - stride] if at >= stride else 1.0 if schedule["set_alpha_to_one"] else alphas[0]
        clean = np.clip((sample - np.sqrt(1 - now) * noise) / np.sqrt(now), -clip, clip)
        sample = (np.sqrt(before) * clean + np.sqrt(1 - before) * noise).astype(np.float32)
    chunk = sample[0]
    for part in described["action"]["normalization"]:
        assert part["mode"] == "min_max"
        low, high = np.array(part["min"]), np.array(part["max"])
        begin, end = part["slice"]
        chunk[:, begin:end] = (chunk[:, begin:end] + 1) / 2 * (high - low) + low
    return chunk


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    arrays = np.load(sys.argv[2])
    apart = np.abs(recompute(Path(sys.argv[1]), arrays) - arrays["recorded"]).max()
    # Not a number is not the same either.
    same = apart <= 1e-4
    print(f"largest difference of {arrays['recorded'].size} numbers: {apart:.2e}{'' if same else ': not the same chunk'}")
    sys.exit(0 if same else 1)
