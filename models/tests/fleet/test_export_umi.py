"""`export_umi.py`: the buffer is read as UMI reads it, and compared with the episode itself."""

import contextlib
import io
import json
import subprocess
import sys
import unittest
from pathlib import Path

import numpy as np
import zarr
from PIL import Image

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
import export_umi
from recorded import Folder, rapid, read_episode

CAMERAS = ["cam_wrist", "tactile_tip"]


def read_buffer(path: Path) -> zarr.Group:
    """As UMI's `UmiDataset`: meta and each array are copied into memory without unpacking."""
    memory = zarr.MemoryStore()
    with zarr.ZipStore(str(path), mode="r") as store:
        names = list(zarr.group(store)["data"].keys())
        root = zarr.group(store=memory)
        zarr.copy_store(source=store, dest=memory, source_path="/meta", dest_path="/meta", if_exists="replace")
        root.create_group("data", overwrite=True)
        for name in names:
            place = f"/data/{name}"
            zarr.copy_store(source=store, dest=memory, source_path=place, dest_path=place, if_exists="replace")
    for name, array in root["data"].items():
        assert array.shape[0] == root["meta"]["episode_ends"][-1], name
    return root


def run(*words: str) -> tuple[int, str]:
    """The exit status, and what is printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = export_umi.main([*words])
    return status, printed.getvalue()


class Buffer(Folder):
    @classmethod
    def setUpClass(cls) -> None:
        super().setUpClass()
        folder = cls.folder
        # The demonstration unplugs the tactile camera after 4 s.
        rapid("--sim", "--headless", "--record", "--out", "episodes", "--duration", "6s", cwd=folder)
        rapid("export", "episodes", "--to", "lerobot", "--out", "set", "--include-bad", cwd=folder)
        (path,) = (folder / "episodes").glob("*.mcap")
        cls.rows = read_episode(path)
        cls.set = str(folder / "set")

    def out(self, name: str) -> Path:
        return self.folder / f"{name}.zarr.zip"

    def test_every_array_is_what_the_episode_has(self) -> None:
        out = self.out("whole")
        pose = ("--pose", "motor_state,motor_state", "--gripper", "motor_state.1*0.5")
        cameras = [word for name in CAMERAS for word in ("--camera", name)]
        status, printed = run(
            self.set, str(out), *cameras, *pose, "--array", "state=motor_state.0-1", "--min-rows", "1", "--verify"
        )
        self.assertEqual(status, 0, printed)
        root = read_buffer(out)
        data, by_time = root["data"], {row["time_ns"]: row for row in self.rows}
        rows = [by_time[int(time)] for time in data["rapid_time_ns"][:]]
        # The motor is there from the beginning to the end, or the pose would have a gap.
        self.assertEqual(rows, [row for row in self.rows if row["valid"][2]])
        for name in ("mask", "plugged", "valid", "age"):
            self.assertEqual(data[f"rapid_{name}"][:].tolist(), [row[name] for row in rows])
        self.assertEqual(data["rapid_mask"].attrs["names"], [*CAMERAS, "motor_state"])
        motor = np.array([row["samples"][2].values for row in rows], "f4")
        np.testing.assert_array_equal(data["robot0_eef_pos"][:], motor)
        np.testing.assert_array_equal(data["robot0_eef_rot_axis_angle"][:], motor)
        np.testing.assert_array_equal(data["robot0_gripper_width"][:], motor[:, 1:2] * np.float32(0.5))
        np.testing.assert_array_equal(data["state"][:], motor[:, :2])
        ends = root["meta/episode_ends"][:]
        for first, last in zip([0, *ends[:-1]], ends, strict=True):
            for name, at in (("start", first), ("end", last - 1)):
                expected = np.tile(motor[at].astype("f8"), (last - first, 2))
                np.testing.assert_array_equal(data[f"robot0_demo_{name}_pose"][first:last], expected)
        black = 0
        for place in range(len(CAMERAS)):
            pictures = data[f"camera{place}_rgb"]
            self.assertEqual((pictures.dtype, pictures.chunks[0]), (np.uint8, 1))
            for at, row in enumerate(rows):
                sample = row["samples"][place]
                black += sample is None
                expected = 0 if sample is None else np.asarray(Image.open(io.BytesIO(sample.data)).convert("RGB"))
                self.assertTrue((pictures[at] == expected).all(), (place, at))
        self.assertGreater(black, 10)

    def test_rows_without_a_required_sensor_end_an_episode(self) -> None:
        out = self.out("cut")
        status, printed = run(
            self.set, str(out), "--camera", "cam_wrist", "--size", "224x224", "--require", "tactile_tip", "--min-rows", "1"
        )
        self.assertEqual(status, 0, printed)
        root = read_buffer(out)
        valid = np.array([row["valid"][1] for row in self.rows])
        runs = np.flatnonzero(np.diff(np.r_[0, valid, 0])).reshape(-1, 2)
        self.assertEqual(root["meta/episode_ends"][:].tolist(), np.cumsum(runs[:, 1] - runs[:, 0]).tolist())
        self.assertTrue((root["data/rapid_valid"][:, 1] == 1).all())
        self.assertEqual(root["data/camera0_rgb"].shape, (int(valid.sum()), 224, 224, 3))
        self.assertIn("tactile_tip not valid", printed)

    def test_a_changed_picture_is_found(self) -> None:
        out, store = self.out("changed"), zarr.MemoryStore()
        self.assertEqual(run(self.set, str(out), "--camera", "tactile_tip")[0], 0)
        with zarr.ZipStore(str(out), mode="r") as file:
            zarr.copy_store(source=file, dest=store)
        options = export_umi.parser().parse_args([self.set, str(out), "--camera", "tactile_tip"])
        features = export_umi.read_info(options.set)
        files = sorted((options.set / "data").glob("*/*.parquet"))
        buffer = export_umi.plan(options, features, export_umi.read_numbers(files, features))
        export_umi.verify(store, buffer, files, None)
        array = zarr.group(store)["data/camera0_rgb"]
        array[7, 3, 5, 1] ^= 1
        with self.assertRaisesRegex(export_umi.Unfit, "camera0_rgb, row 7 differs"):
            export_umi.verify(store, buffer, files, None)

    def test_refusals(self) -> None:
        for words, expected in (
            ("", "nothing to export"),
            ("--camera x", "the cameras of the dataset are cam_wrist, tactile_tip"),
            ("--pose motor_state --gripper motor_state.0", "3 numbers, a pose is 6, 7 or 16"),
            ("--pose motor_state", "1 --pose and 0 --gripper"),
            ("--array a=motor_state.0-7", "no motor_state.3; the dataset has motor_state.0"),
            ("--array a/b=motor_state", "not NAME=COLUMNS"),
            ("--array a=action", "no action"),
            ("--require x --camera cam_wrist", "--require x: the sensors"),
            ("--camera cam_wrist --min-rows 9999", "no row is left"),
        ):
            status, printed = run(self.set, str(self.out("none")), *words.split())
            self.assertEqual((status, expected in printed), (1, True), (words, printed))
        self.assertEqual(list(self.folder.glob("*none*")), [])
        status, printed = run(str(self.folder), str(self.out("none")), "--camera", "cam_wrist")
        self.assertIn("meta/info.json: not a dataset that `rapid export --to lerobot` wrote", printed)
        earlier = self.folder / "earlier"
        (earlier / "meta").mkdir(parents=True)
        info = json.loads((Path(self.set) / "meta/info.json").read_text(encoding="utf-8"))
        del info["features"]["rapid.plugged"]
        (earlier / "meta/info.json").write_text(json.dumps(info), encoding="utf-8")
        status, printed = run(str(earlier), str(self.out("none")), "--camera", "cam_wrist")
        fix = "info.json: no rapid.plugged: exported by an earlier version: export again"
        self.assertEqual((status, fix in printed), (1, True), printed)

    def test_help_needs_no_package(self) -> None:
        script = Path(export_umi.__file__)
        done = subprocess.run([sys.executable, "-S", "-E", script, "--help"], capture_output=True, check=False)
        self.assertEqual((done.returncode, b"--pose COLUMNS" in done.stdout), (0, True), done.stderr)


class Columns(unittest.TestCase):
    def test_a_name_may_end_in_a_number(self) -> None:
        state = {"columns": ["arm.0", "arm.1", "arm.2"], "names": ["arm.shoulder.3", "arm.elbow", "arm.0"]}
        for text, places in (
            ("arm.shoulder.3", [0]),
            ("arm.elbow,arm.2", [1, 2]),
            ("arm.0-1", [0, 1]),
            ("arm", [0, 1, 2]),
            # The number in the sample, which the name of another column does not change.
            ("arm.0", [0]),
        ):
            found = export_umi.columns("--pose", text, {"observation.state": state})
            self.assertEqual(found.places, [("observation.state", at) for at in places], text)
            self.assertEqual(found.sensors, ["arm"])
        with self.assertRaisesRegex(export_umi.Unfit, "no arm.shoulder.4"):
            export_umi.columns("--pose", "arm.shoulder.4", {"observation.state": state})


class Poses(unittest.TestCase):
    """A quarter turn about z at (1, 2, 3), in each form."""

    def test_the_three_forms_are_one_pose(self) -> None:
        expected = [[1, 2, 3, 0, 0, np.pi / 2]]
        half = np.sqrt(0.5)
        # Column by column: x becomes y, y becomes -x.
        matrix = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]
        for values in (expected[0], [1, 2, 3, 0, 0, half, half], matrix):
            np.testing.assert_allclose(export_umi.six(np.array([values], float)), expected, atol=1e-12)

    def test_what_is_no_rotation_is_no_number(self) -> None:
        mirrored = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]
        for values in ([1, 2, 3, 0, 0, 0, 0], [0] * 16, mirrored):
            self.assertTrue(np.isnan(export_umi.six(np.array([values], float))[0, 3:]).all(), values)


if __name__ == "__main__":
    unittest.main()
