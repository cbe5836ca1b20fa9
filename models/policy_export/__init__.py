"""Turns checkpoints of other projects into policy bundles (`models/README.md` has their format).

`lerobot` and `umi` each read a kind of checkpoint: `config` (what it states about itself, or why it cannot be exported)
-> `checkpoint` (its networks and normalisation) -> `graphs` (two ONNX graphs) and `bundle` (policy.json, README.md)
-> `verify` (the bundle, run by `runtime` as the program runs it, against the networks in PyTorch). What they have in
common is here, and `commands` has what their command lines share.

Invariant: `config` and `runtime` need no PyTorch: the bundle is judged by code that shares nothing with what wrote it.
Invariant: a bundle gets its name only once it is verified.
"""


class Unsupported(Exception):
    """Something that cannot be exported. The message names the file, its key and, if there is one, the fix."""
