"""Matches with noisy affinities of random facets, with outliers, to measure the speed on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.affine.normal import affines_from_normals
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.matches import Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit

CAMERA = Pinhole((1624, 1240), np.array([1350.0, 1350.0, 800.0, 620.0]))

POSE = Rigid3(exp_so3(np.array([0.0, 0.1, 0.0])), [-290.0, 0.0, -70.0])

NOISE_PX, SIGMA_A = 0.3, 0.02


@dataclass(frozen=True)
class Condition:
    """What a scene for the robust pose is like; `understated` is the actual noise over the stated one."""

    name: str
    outliers: float = 0.4
    noise_px: float = NOISE_PX
    understated: float = 1.0
    count: int = 300
    pose: Rigid3 = POSE
    flat: bool = False


PLAIN = Condition("40% wrong")

CONDITIONS = (
    PLAIN,
    *(Condition(f"{share:.0%} wrong", outliers=share) for share in (0.0, 0.2, 0.6, 0.8)),
    *(Condition(f"40% wrong, noise {noise} px", noise_px=noise) for noise in (0.1, 1.0, 2.0)),
    Condition("40% wrong, noise 3 times the stated", understated=3.0),
    Condition("40% wrong, one slanted plane", flat=True),
    Condition("40% wrong, forward motion", pose=Rigid3(np.eye(3), [0.0, 0.0, -150.0])),
    Condition(
        "40% wrong, baseline 2% of the depth", pose=Rigid3(exp_so3(np.array([0.0, 0.02, 0.0])), [-27.0, 0.0, 0.0])
    ),
    Condition("40% wrong, 60 matches", count=60),
    Condition("40% wrong, 2000 matches", count=2000),
)


def scene(rng: np.random.Generator, count: int, like: Condition = PLAIN) -> Matches:
    """Return matches in view of both cameras with noisy affinities of random facets."""
    X = rng.uniform([-350, -300, 900], [350, 300, 1800], (count, 3))
    if like.flat:
        X[:, 2] = 1300.0 + 0.8 * X[:, 0] + 0.3 * X[:, 1]
    q1, q2 = CAMERA.project(X)[0], CAMERA.project(like.pose.apply(X))[0]
    exact = Matches.from_cameras(CAMERA, CAMERA, q1, q2)
    facets = unit(-unit(X) + 0.4 * rng.normal(size=X.shape))
    A21 = affines_from_normals(*jacobians(exact, X, like.pose), facets)[0] + rng.normal(size=(count, 2, 2)) * SIGMA_A
    noise1, noise2 = (rng.normal(size=q1.shape) * like.noise_px * like.understated for _ in range(2))
    sigma = np.full(count, like.noise_px)
    return Matches.from_cameras(
        CAMERA,
        CAMERA,
        q1 + noise1,
        q2 + noise2,
        sigma1_px=sigma,
        sigma2_px=sigma,
        A21=A21,
        sigma_A=np.full(count, SIGMA_A),
    )


def jacobians(m: Matches, points: np.ndarray, pose: Rigid3 = POSE) -> tuple[np.ndarray, np.ndarray]:
    return pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, pose)


def contaminated(rng: np.random.Generator, like: Condition = PLAIN) -> Matches:
    m = scene(rng, like.count, like)
    wrong = rng.random(like.count) < like.outliers
    q2, A21 = np.array(m.pixels2), np.array(m.A21)
    q2[wrong] = rng.uniform([0, 0], CAMERA.size_px, (wrong.sum(), 2))
    A21[wrong] = np.eye(2) + 0.4 * rng.normal(size=(wrong.sum(), 2, 2))
    sigma = m.sigma1_px
    return Matches.from_cameras(
        CAMERA, CAMERA, m.pixels1, q2, sigma1_px=sigma, sigma2_px=sigma, A21=A21, sigma_A=m.sigma_A
    )
