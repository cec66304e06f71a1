"""Examples of every verb, for the end of `rigkit VERB --help`."""

from __future__ import annotations

FIRST_STEPS = """first steps:
  rigkit board 9x6 --square-mm 25 -o board           print a board, glue it to something flat
  rigkit calibrate photos --board 9x6x25 -r          calibrate from a dozen images of it, with a report
  rigkit rectify photos --camera photos/calibration.json -o straight
  rigkit demo                                        every step once, on rendered images
  rigkit VERB --help                                 options and examples of a verb

Exit codes: 0 success; 1 a check failed; 2 bad input; 3 degenerate geometry; 70 a bug in rigkit.
"""

EXAMPLES: dict[str, str] = {
    "demo": """\
  rigkit demo                          renders, calibrates, reconstructs, validates: rigkit-demo/out/report.html
  rigkit demo -o demo-7 --seed 7       another random scene
""",
    "detect": """\
  rigkit detect photos                                        chessboards of any size
  rigkit detect photos --board 9x6x25 -o corners.csv --overlay seen     to a file, with pictures of the corners
  rigkit detect film.mp4 --board board.toml --camera calibration.json -o corners.csv
""",
    "calibrate": """\
  rigkit calibrate photos --board 9x6x25 -r          one camera; 9x6 inner corners, 25 mm squares; with a report
  rigkit calibrate photos --square-mm 25 -r          the same; the board is identified from the images
  rigkit calibrate left right --board board.toml     a rig, one folder per camera (or one folder: left01, right01, ...)
  rigkit calibrate photos --board 9x6x25 --export opencv ros
  rigkit calibrate left right --board 9x6x25 --only-extrinsics left.json right.json -o rig.json
  rigkit calibrate left right top --board 9x6x25 --add-camera rig.json -o rig3.json
  rigkit calibrate session.toml --force              repeat it from the session file
""",
    "diff": """\
  rigkit diff monday.json friday.json -r diff.html      a report with the map of the difference
  rigkit diff rig.json rig-new.json                     intrinsics and extrinsics
  rigkit diff calibration.json camchain.yaml            a file of another tool: no covariance, so no verdict
""",
    "certify": """\
  rigkit certify rig.json --length 800 --distance 1500 -r certificate.html
  rigkit certify rig.json --depth 100 --distance 2000 --limit 5 --pdf certificate.pdf      exit 1 above 5 mm
  rigkit certify calibration.json --length 50 --distance 400 --distance-sigma 1
""",
    "plan": """\
  rigkit plan calibration.json -r next.html               the three images that would help most, drawn
  rigkit plan rig.json                                    the same for a rig, of all cameras at once
  rigkit plan calibration.json --check                    the three best images for rigkit check
  rigkit plan session.toml -n 5 --length 800 --distance 1500
  rigkit plan --lens 120 --size 1280x960 --board 9x6x30 --views 12
""",
    "coach": """\
  rigkit coach capture --board 9x6x25                     a camera of the browser
  rigkit coach capture --board 9x6x25 --device 0 --goal 0.05
  rigkit coach capture --board 9x6x25 --watch incoming    images that another program writes
""",
    "check": """\
  rigkit check calibration.json fresh/*.png                 one to three images of the board
  rigkit check rig.json fresh/left fresh/right --board 9x6x25 --fix rig-fixed.json
  rigkit check rig.json left1.png right1.png --scene         any textured scene instead of a board
  rigkit check rig.json left right --scene --before old/left old/right      changes since the old images only
  rigkit check calibration.json fresh -r check.html --register calib/history/cam.jsonl --temperature 21.5
""",
    "history": """\
  rigkit history calib/history/cam.jsonl -r history.html
  rigkit history cam.jsonl --add new.json --to calibration.json      the change from an old calibration to a new one
""",
    "pose": """\
  rigkit pose floor.jpg --camera calibration.json --board 9x6x25
  rigkit pose floor.jpg --camera camera.yaml --board board.toml --json
""",
    "handeye": """\
  rigkit handeye poses.csv images --camera calibration.json --board board.toml -o hand-eye.json
  rigkit handeye poses.csv images --camera calibration.json --board board.toml --board-on-hand
""",
    "rectify": """\
  rigkit rectify photo.jpg --camera calibration.json -o straight.png
  rigkit rectify photos --camera calibration.json -o straight --crop      a whole folder
  rigkit rectify left right --rig rig.json -o rectified --maps maps.npz       rectified stereo pairs; K, P, Q, maps
  rigkit rectify photos --rig rig.json -o rectified          one folder of left01, right01, ...
  rigkit rectify fisheye.jpg --camera fisheye.json -o round.png --projection equirectangular
""",
    "reconstruct": """\
  rigkit reconstruct lab                          the pairs of lab/dataset.toml (rigkit init writes one)
  rigkit reconstruct lab -p first --planes lattice
  rigkit reconstruct --images left.png right.png --rig rig.json -o scene
  rigkit reconstruct --images a.png b.png --camera calibration.json --baseline-mm 250 -o scene
""",
    "mesh": """\
  rigkit mesh scene/scene.ply
  rigkit mesh scene/scene.ply -o surface.ply --depth 10 --cut 0.05
""",
    "validate": """\
  rigkit validate lab                             report, tables and clouds in out/lab
  rigkit validate lab -p first -o results --force
  rigkit validate monday tuesday wednesday        several data sets, one table
  rigkit validate lab --paper                     the paper's own pipeline, beside its printed tables
""",
    "simulate": """\
  rigkit simulate study.toml -o results
  rigkit simulate study.toml --trials 20 --format pdf      fewer trials; vector graphics
""",
    "crosscheck": """\
  rigkit crosscheck lab
  rigkit crosscheck lab -p first --json
""",
    "fetch": """\
  rigkit fetch                          list the captures
  rigkit fetch caliper-board -o data
""",
    "init": """\
  rigkit init lab --square-mm 50 --calibration camera.json --pose-type general --baseline-mm first=300+-2 \\
      --angle-deg 90+-0.3                            as measured by ruler and set square
  rigkit init lab --square-mm 50 --calibration left.json --calibration right.json --pose-type standard
  rigkit init lab --square-mm 50 --calibration wide=w.json --calibration tele=t.json \\
      --cameras 'w-*=wide,wide' --cameras 't-*=tele,tele' --pose-type 'w-*=forward' --pose-type general
  rigkit init lab --board aprilgrid:6x6x88,spacing=0.3 --calibration camera.json --pose-type general
  rigkit init photos --session --board 9x6x25        a session for rigkit calibrate
""",
    "export": """\
  rigkit export calibration.json -o camera.yaml --to opencv
  rigkit export rig.json -o camchain.yaml --to kalibr
  rigkit export rig.json -o rig --to ros --names left right
  rigkit export camchain.yaml -o camera.json --to rigkit      import the file of another tool
  rigkit export lab -p first -o cloud.ply
""",
    "board": """\
  rigkit board 9x6 --square-mm 25 -o board                      a chessboard of 9 by 6 inner corners
  rigkit board 8x11 --square-mm 15 --charuco DICT_5X5_100 -o charuco
  rigkit board aprilgrid:6x6x25,spacing=0.3 -o grid
  rigkit board board.toml --ruler-x-mm 250.4 --ruler-y-mm 170.2 --sigma-mm 0.2      as measured on the print
  rigkit board identify photos                                  which board the images show
""",
    "schema": """\
  rigkit schema                          list the file formats
  rigkit schema session --keys           every key of a session file with its meaning
  rigkit schema session -o session.json  for editors: first line of the session #:schema ./session.json
""",
}
"""Verb -> example commands with comments."""
