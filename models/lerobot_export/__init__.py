"""Turns a LeRobot DiffusionPolicy checkpoint into a policy bundle (`models/README.md` has its format).

Folder of a checkpoint -> `config` (what it states about itself, or why it cannot be exported) -> `checkpoint`
(LeRobot's own policy and normalisation) -> `graphs` (two ONNX graphs) and `bundle` (policy.json, README.md)
-> `verify` (the bundle, run by `runtime` as the program runs it, against LeRobot).

Invariant: `config` and `runtime` need no LeRobot: a checkpoint is refused before anything large is loaded, and the
bundle is judged by code that shares nothing with what wrote it.
Invariant: a bundle gets its name only once it is verified.
"""


class Unsupported(Exception):
    """Something that cannot be exported. The message names the file, its key and, if there is one, the fix."""
