"""Files of episodes that tests write: MCAP with the messages that the program records, and nothing of the program."""

import io
import json
from pathlib import Path

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.writer import Writer
from PIL import Image

Field = descriptor_pb2.FieldDescriptorProto
MESSAGES = {
    "foxglove.CompressedImage": {2: ("data", "BYTES"), 3: ("format", "STRING"), 4: ("frame_id", "STRING")},
    "foxglove.RawImage": {
        2: ("width", "FIXED32"),
        3: ("height", "FIXED32"),
        4: ("encoding", "STRING"),
        5: ("step", "FIXED32"),
        6: ("data", "BYTES"),
    },
    "rapid.Scalars": {2: ("values", "DOUBLE")},
    "rapid.Frame": {2: ("index", "UINT64"), 3: ("mask", "FIXED64"), 4: ("modalities", "MESSAGE")},
}
SLOT = {
    1: ("bit", "UINT32"),
    2: ("valid", "BOOL"),
    3: ("stale", "BOOL"),
    4: ("age_ns", "SINT64"),
    5: ("seq", "UINT64"),
    6: ("present", "BOOL"),
    7: ("plugged", "BOOL"),
}


def schema(name: str) -> tuple[bytes, type]:
    """The descriptors of a message as a file has them, and its class."""
    package, short = name.split(".")
    file = descriptor_pb2.FileDescriptorProto(name=f"{short}.proto", package=package, syntax="proto3")
    message = file.message_type.add(name=short)
    for number, (field, kind) in MESSAGES[name].items():
        repeated = field in ("values", "modalities")
        label = Field.LABEL_REPEATED if repeated else Field.LABEL_OPTIONAL
        added = message.field.add(name=field, number=number, label=label, type=getattr(Field, f"TYPE_{kind}"))
        if kind == "MESSAGE":
            added.type_name = f".{package}.{short}.Slot"
            slot = message.nested_type.add(name="Slot")
            slot.oneof_decl.add(name="_seq")
            for at, (inner, inner_kind) in SLOT.items():
                one = slot.field.add(
                    name=inner, number=at, label=Field.LABEL_OPTIONAL, type=getattr(Field, f"TYPE_{inner_kind}")
                )
                if inner == "seq":
                    one.proto3_optional, one.oneof_index = True, 0
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), made


def jpeg(pixels: np.ndarray, kind: str = "JPEG") -> dict:
    """The fields of a compressed picture."""
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, kind)
    return {"data": out.getvalue(), "format": kind.lower()}


def write(
    path: Path,
    samples: dict[str, tuple[str, list[dict | str | None]]],
    *,
    hz: float = 10,
    actions: np.ndarray | None = None,
    tags: dict[str, str] | None = None,
    modules: tuple[str, ...] = (),
    poses: dict[str, str] | None = None,
    late: dict[str, int] | None = None,
) -> Path:
    """Writes an episode: by modality its schema and a sample a tick, or None where it was unplugged, "crash" where its
    driver did not run, "stall" where it sent nothing.

    `late`: ticks by which the sample that belongs to a tick was captured after it, with that latency in the metadata.
    """
    period, late = round(1e9 / hz), late or {}
    names = list(samples)
    length = max(len(rows) for _, rows in samples.values())
    listed = [
        {
            "name": name,
            "bit": bit,
            "topic": f"/{name}",
            "kind": "",
            "shape": [],
            "when_stale": "zero",
            "latency_ns": late.get(name, 0) * period,
        }
        for bit, name in enumerate(names)
    ]
    registry = "".join(f'[device.{name}.pose]\nlayout = "{layout}"\n' for name, layout in (poses or {}).items())
    about = {
        "software": "a test",
        "observation_hz": str(hz),
        "modalities": json.dumps(listed),
        "tags": json.dumps(tags or {}),
        "configuration": json.dumps({"modules": modules}),
        "registry": registry,
    }
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("rapid", about)
        classes, ids = {}, {}
        for name in ("rapid.Frame", "rapid.Scalars", *(kind for kind, _ in samples.values())):
            if name not in classes:
                described, classes[name] = schema(name)
                ids[name] = writer.register_schema(name, "protobuf", described)

        def send(topic: str, kind: str, at: int, sequence: int, **fields) -> None:
            channel = channels.setdefault(topic, writer.register_channel(topic, "protobuf", ids[kind]))
            data = classes[kind](**fields).SerializeToString()
            writer.add_message(channel, at, data, at, sequence)

        channels: dict[str, int] = {}
        for tick in range(length):
            slots = []
            for bit, name in enumerate(names):
                kind, rows = samples[name]
                if tick >= len(rows) or rows[tick] is None:
                    slots.append({"bit": bit})
                    continue
                if isinstance(rows[tick], str):
                    slots.append({"bit": bit, "plugged": True, "present": rows[tick] == "stall"})
                    continue
                # Numbers begin where each modality likes, as those of a device that ran before the episode.
                sequence = 1000 * (bit + 1) + tick
                send(f"/{name}", kind, (tick + late.get(name, 0)) * period, sequence, **rows[tick])
                flags = {"valid", "present", "plugged"} & {field for field, _ in SLOT.values()}
                slots.append({"bit": bit, "seq": sequence, "age_ns": 0} | dict.fromkeys(flags, True))
            send("/rapid/frame", "rapid.Frame", tick * period, tick, index=tick, modalities=slots)
            if actions is not None:
                send("/action", "rapid.Scalars", tick * period, tick, values=actions[tick])
        writer.finish()
    return path


def by_hand(path: Path, track: np.ndarray, opening: np.ndarray, **about) -> Path:
    """A handheld demonstration: two cameras, a phone, a gripper, no action."""
    count = len(track)
    pictures = [jpeg(np.full((96, 96, 3), 10 * (t % 20), np.uint8)) for t in range(count)]
    samples = {
        "cam_wrist": ("foxglove.CompressedImage", pictures),
        "tactile_tip": ("foxglove.CompressedImage", pictures),
        "phone": ("rapid.Scalars", [{"values": p.T.ravel()} for p in track]),
        "gripper": ("rapid.Scalars", [{"values": [v]} for v in opening]),
    }
    return write(path, samples, **{"poses": {"phone": "columns"}, "modules": ("handheld",), **about})
