"""Calls of public names that a type checker refuses: mypy runs over this file, nothing executes it.

Every `type: ignore` names the error that must be found. One that mypy does not find is an error itself
(`warn_unused_ignores`), so a public name that turns into `Any` fails the check.
"""

from __future__ import annotations

from pathlib import Path
from typing import assert_type

import rigkit

# Wrong types, missing and unknown arguments, misspelt names.
rigkit.Board("a", "oops", 6, 50.0, 50.0)  # type: ignore[arg-type]
rigkit.Board("a", 8, 6, 50.0)  # type: ignore[call-arg]
rigkit.detect_boards(1)  # type: ignore[arg-type]
rigkit.detect_boards(rigkit.read_image(Path("a.png")), boards=3)  # type: ignore[arg-type]
rigkit.detect_boards(rigkit.read_image(Path("a.png")), "9x6x25")  # type: ignore[arg-type]
rigkit.board_of_words(3)  # type: ignore[arg-type]
rigkit.detect_bords(rigkit.read_image(Path("a.png")))  # type: ignore[attr-defined]
rigkit.load_camera(3)  # type: ignore[arg-type]
rigkit.load_calibration("a.json").reprojection_error  # type: ignore[attr-defined]  # noqa: B018
rigkit.load_rig("rig.json").cameras  # type: ignore[attr-defined]  # noqa: B018
rigkit.calibrate_rig(1, {})  # type: ignore[arg-type]
rigkit.write_ply(Path("a.ply"), "cloud")  # type: ignore[arg-type]
rigkit.check_pictures("calibration.json", 3)  # type: ignore[arg-type]
rigkit.plan_session("session.toml", rigkit.PlanOptions(counts=3))  # type: ignore[call-arg]
rigkit.plan_lens(rigkit.LensOptions(hfov_deg=90.0), rigkit.PlanOptions())  # type: ignore[call-arg]
rigkit.mesh_cloud("cloud.ply", rigkit.MeshOptions(output="mesh.ply"))  # type: ignore[arg-type]
rigkit.show_history("register.jsonl")  # type: ignore[arg-type]
rigkit.add_to_history(Path("register.jsonl"), Path("calibration.json"))  # type: ignore[call-arg]
rigkit.run_coach(Path("session"), print)  # type: ignore[arg-type]
rigkit.validate_as_paper("lab-a", rigkit.DatasetOptions())  # type: ignore[arg-type]
rigkit.reconstruct_rig_views("rig.json")  # type: ignore[arg-type]
rigkit.validate_datasets(["lab-a"], 2)  # type: ignore[arg-type]
rigkit.identify_board(Path("photos"))  # type: ignore[arg-type]
rigkit.fetch_public_set("caliper-board")  # type: ignore[arg-type]

# What comes back is known as well.
assert_type(rigkit.load_camera(Path("camera.json")), rigkit.Camera)
assert_type(rigkit.load_calibration(Path("calibration.json")).camera, rigkit.Camera)
assert_type(rigkit.Board("a", 8, 6, 50.0, 50.0).corner_count, int)
assert_type(rigkit.__version__, str)
