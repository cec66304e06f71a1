"""A capture with what a person measured of it: verdicts on every fact, and an oriented cloud.

python examples/against_a_ruler.py datasets/lab-a [PAIR]
"""

# %% What there is: a folder with dataset.toml, which `rigkit init` starts.
import sys
from pathlib import Path

import rigkit

dataset = rigkit.load_dataset(sys.argv[1])
pairs = dataset.select(sys.argv[2:])
out = Path("out") / "example"

# %% Everything that was measured, by every estimator, and by other methods.
done = rigkit.validate_dataset(
    pairs,
    rigkit.ValidateOptions(output=out, pictures=False, crosscheck=False, force=True),
    progress=rigkit.notebook_progress(),
)
for pair in done.pairs:
    for check in pair.best.checks:
        verdict = "holds" if check.passed else "FAILS"
        print(f"{pair.pair_id}: {check.name} {check.ours:.3f} {check.unit}, measured {check.measured:g}: {verdict}")
for cause in done.causes:
    print(cause.text)

# %% The cloud: points, normals, colours and sigmas, for any tool that reads PLY.
best = done.pairs[0].best
cloud = rigkit.read_ply(out / best.pair_id / f"{best.affine_method}.ply")
print(len(cloud), "oriented points of", ", ".join(cloud.board_ids))
