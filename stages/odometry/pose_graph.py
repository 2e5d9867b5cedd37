"""Pose graph: the poses at which many measured motions between frames contradict each other least.

A factor measures the pose ``T_a_b`` of one node in the frame of another, with a covariance in the frame of ``a``, or
some components of it alone. Errors that many factors share are unknowns of their own (``sources``), whose standard
deviation is 1: what all segments share so adds up over a chain, and a closed loop may still correct it.

Two things are estimated besides. First, the false ones among the doubtful factors: those whose whitened error exceeds a
``bound`` once the others hold, by graduated non-convexity (Yang et al. 2020, doi:10.1109/LRA.2020.2965893): first all
count, then the cost is bent towards a truncated one. Second, the factor k >= 1 by which the chain's own errors exceed
their covariances: the least with which most factors agree, and their errors are as large as stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.geometry.geometry import cross_matrix, rotation_exp, rotation_log
from rille.stages.numeric.least_squares import NormalEquations, levenberg_marquardt

EXCESS = (1.0, 2.0, 5.0, 10.0, 30.0)
"""Factors k that are tried: on recorded sequences errors were up to 30 times those stated."""
MAJORITY = 0.7
"""Share of the doubtful factors that have to agree."""
MAX_ROUNDS, GRADUATION = 40, 2.0
"""Rounds of graduated non-convexity, and the factor that brings each nearer to the truncated cost."""
MAX_SOURCE = 4.0
"""Standard deviations from which on an error that many factors share is not believed."""
STEPS, FEW_STEPS = 30, 3
"""Steps of a whole adjustment, and of one round."""


@dataclass(frozen=True)
class Factors:
    """Measured poses ``T_a_b`` of m pairs of nodes.

    ``ends`` (m, 2) nodes a, b; ``poses`` (m, 3, 4), m; ``root`` (m, 6, 6) root W of the information ``W^T W`` of
    (position m, rotation rad) in the frame of a, rows of zeros where nothing is measured; ``shared`` (m, 6, q) errors
    per standard deviation of the sources; ``lever`` (m, 3), m, of the point in the frame of b whose position is
    measured; ``bound`` (m,) of squared whitened errors, infinite: the factor is not doubted, as those of the chain.
    """

    ends: NDArray[np.intp]
    poses: Floats
    root: Floats
    shared: Floats
    lever: Floats
    bound: Floats

    @staticmethod
    def of(
        ends: NDArray[np.intp],
        poses: Floats,
        root: Floats,
        components: int = 0,
        shared: Floats | None = None,
        lever: Floats | None = None,
    ) -> Factors:
        """Factors that measure so many ``components`` and are doubted; 0: they are not doubted."""
        # One in a hundred true factors has a longer whitened error.
        bound = np.full(len(ends), scipy.special.chdtri(components, 0.01) if components else np.inf)
        shared = np.zeros((len(ends), 6, 0)) if shared is None else shared
        return Factors(ends, poses, root, shared, np.zeros((len(ends), 3)) if lever is None else lever, bound)

    @staticmethod
    def joined(parts: Sequence[Factors]) -> Factors:
        """All factors of some parts, each part with sources of its own."""
        names, width = ("ends", "poses", "root", "lever", "bound"), sum(part.shared.shape[2] for part in parts)
        shared, column = [], 0
        for part in parts:
            more = part.shared.shape[2]
            shared.append(np.pad(part.shared, ((0, 0), (0, 0), (column, width - column - more))))
            column += more
        return Factors(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names}, shared=np.vstack(shared))

    def beside(self, others: Factors) -> Factors:
        """These factors and others with the same sources."""
        return Factors(**{name: np.concatenate([value, getattr(others, name)]) for name, value in vars(self).items()})

    def take(self, chosen: NDArray[np.intp]) -> Factors:
        """The factors of these numbers."""
        return Factors(**{name: value[chosen] for name, value in vars(self).items()})

    @property
    def motions(self) -> Floats:
        """Poses (m, 3, 4) of b in the frame of a, also where those of a point beside b are measured."""
        place = self.poses[:, :, 3] - np.einsum("mij,mj->mi", self.poses[:, :, :3], self.lever)
        return np.concatenate([self.poses[:, :, :3], place[:, :, None]], axis=2)

    @property
    def doubtful(self) -> Bools:
        """Which (m,) are no part of the chain."""
        return np.isfinite(self.bound)


def root_of(covariance: Floats) -> Floats:
    """Roots W (..., 6, 6) of the inverses of covariances: ``W^T W C = 1``."""
    # Metres and radians differ by orders: scaled to correlations the factorisation stays exact.
    sigma = np.sqrt(np.einsum("...ii->...i", covariance))
    unit = covariance / (sigma[..., :, None] * sigma[..., None, :])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(unit)) / sigma[..., None, :])


class GraphState(NamedTuple):
    """Poses (n, 3, 3) and positions (n, 3), m, of the nodes, and the sources (q,) in standard deviations."""

    R: Floats
    C: Floats
    sources: Floats

    @staticmethod
    def of(poses: Floats, sources: int) -> GraphState:
        """Poses (n, 3, 4) as they are, no source in error."""
        return GraphState(poses[:, :, :3].copy(), poses[:, :, 3].copy(), np.zeros(sources))

    @property
    def poses(self) -> Floats:
        """Poses (n, 3, 4)."""
        return np.concatenate([self.R, self.C[:, :, None]], axis=2)


@dataclass(frozen=True)
class PoseGraph:
    """Factors between ``nodes`` nodes, of which the first is held, with a weight (m,) each.

    ``excess`` is the factor k on the errors of the chain, and of its first ``common`` sources.
    """

    factors: Factors
    nodes: int
    weight: Floats
    excess: float = 1.0
    common: int = 0

    @property
    def unknowns(self) -> int:
        """Number of unknowns, of poses and sources."""
        return 6 * (self.nodes - 1) + int(self.factors.shared.shape[2])

    @cached_property
    def _scale(self) -> Floats:
        """Factor (m,) on whitened errors: those of the chain are divided by k."""
        return np.asarray(np.where(self.factors.doubtful, np.sqrt(self.weight), 1.0 / self.excess))

    @cached_property
    def _prior(self) -> Floats:
        """Information (q,) of the sources."""
        sources = np.arange(self.factors.shared.shape[2])
        return np.asarray(np.where(sources < self.common, self.excess**-2.0, 1.0))

    def parts(self, kept: Bools) -> NDArray[np.int32]:
        """Parts (n,), from 0 on, of the nodes, each connected by factors that are kept (m,) and measure positions."""
        a, b = self.factors.ends[kept & (self.factors.root[:, :, :3] != 0).any((1, 2))].T
        links = scipy.sparse.coo_array((np.ones(len(a)), (a, b)), shape=2 * (self.nodes,))
        return np.asarray(scipy.sparse.csgraph.connected_components(links, directed=False)[1])

    def errors(self, state: GraphState) -> Floats:
        """Whitened errors (m, 6) of the factors, before weights."""
        off = self._difference(state)[0] - self.factors.shared @ state.sources
        return np.asarray(np.einsum("mij,mj->mi", self.factors.root, off))

    def _difference(self, state: GraphState) -> tuple[Floats, Floats, Floats]:
        """Errors (m, 6) in the frame of a, with sources; in the world displacements (m, 3) from a to b, and levers."""
        f = self.factors
        a, b = f.ends.T
        back, lever = np.swapaxes(state.R[a], 1, 2), np.einsum("mij,mj->mi", state.R[b], f.lever)
        way = state.C[b] + lever - state.C[a]
        position = np.einsum("mij,mj->mi", back, way) - f.poses[:, :, 3]
        rotation = rotation_log(back @ state.R[b] @ np.swapaxes(f.poses[:, :, :3], 1, 2))
        return np.concatenate([position, rotation], axis=1), way, lever

    def normal(self, state: GraphState) -> NormalEquations:
        """Normal equations of the weighted factors and of the sources' own information."""
        f, (off, way, lever) = self.factors, self._difference(state)
        root = self._scale[:, None, None] * f.root
        white = np.einsum("mij,mj->mi", root, off - f.shared @ state.sources)
        back = np.swapaxes(state.R[f.ends[:, 0]], 1, 2)
        of_a, of_b = np.zeros((2, len(off), 6, 6))
        # The vector of a rotation that is in error changes by that of the turn up to half their product.
        of_b[:, :3, :3], of_b[:, 3:, 3:] = back, (np.eye(3) - 0.5 * cross_matrix(off[:, 3:])) @ back
        of_a[:] = -of_b
        of_a[:, :3, 3:], of_b[:, :3, 3:] = back @ cross_matrix(way), -back @ cross_matrix(lever)
        jacobian = root @ np.concatenate([of_a, of_b, -f.shared], axis=2)
        sources = 6 * (self.nodes - 1) + np.arange(f.shared.shape[2])
        first = np.where(f.ends > 0, 6 * (f.ends - 1), self.unknowns)
        nodes = (first[:, :, None] + np.arange(6)).reshape(len(off), 12)
        columns = np.concatenate([nodes, np.broadcast_to(sources, (len(off), len(sources)))], axis=1)
        rows = np.broadcast_to(np.arange(6 * len(off)).reshape(-1, 6, 1), jacobian.shape)
        placed = jacobian.reshape(-1), (rows.reshape(-1), np.repeat(columns, 6, axis=0).reshape(-1))
        # The held node's columns lie behind the unknowns and are cut off.
        J = scipy.sparse.csr_array(placed, shape=(6 * len(off), self.unknowns + 6))[:, : self.unknowns]
        own = np.concatenate([np.zeros(6 * (self.nodes - 1)), self._prior])
        gradient = J.T @ white.reshape(-1)
        gradient[sources] += self._prior * state.sources
        cost = 0.5 * float((white**2).sum() + (self._prior * state.sources**2).sum())
        return NormalEquations(scipy.sparse.csc_array(J.T @ J + scipy.sparse.diags_array(own)), gradient, cost)

    def ahead(self, state: GraphState, normal: NormalEquations, damping: float) -> GraphState:
        """State after one step, the diagonal enlarged by ``damping`` times itself."""
        damped = normal.matrix + scipy.sparse.diags_array(damping * normal.matrix.diagonal())
        step = -_factorised(damped).solve(normal.gradient)
        nodes = np.vstack([np.zeros(6), step[: 6 * (self.nodes - 1)].reshape(-1, 6)])
        sources = state.sources + step[6 * (self.nodes - 1) :]
        return GraphState(rotation_exp(nodes[:, 3:]) @ state.R, state.C + nodes[:, :3], sources)

    def covariance(self, state: GraphState) -> Floats:
        """Covariances (n, 6, 6) of (position m, rotation rad) against the held node."""
        solver, out = _factorised(self.normal(state).matrix), np.zeros((self.nodes, 6, 6))
        for node in range(1, self.nodes):
            first = 6 * (node - 1)
            block = solver.solve(np.eye(self.unknowns, 6, -first))[first : first + 6]
            out[node] = 0.5 * (block + block.T)
        return out

    def source_sigmas(self, state: GraphState) -> Floats:
        """Standard deviations (q,) of the sources, which were 1 before anything was measured."""
        first, count = 6 * (self.nodes - 1), self.factors.shared.shape[2]
        inverse = _factorised(self.normal(state).matrix).solve(np.eye(self.unknowns, count, -first))
        return np.asarray(np.sqrt(inverse[first:].diagonal()))


def _factorised(matrix: scipy.sparse.csc_array) -> scipy.sparse.linalg.SuperLU:
    """Factors of a symmetric positive definite matrix."""
    return scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(matrix), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


class Adjusted(NamedTuple):
    """A graph with the weights (0 or 1) and the excess that were found, and its state."""

    graph: PoseGraph
    state: GraphState

    @property
    def kept(self) -> Bools:
        """Which factors (m,) count."""
        return self.graph.weight > 0

    @property
    def strained(self) -> bool:
        """Whether an error that the whole chain shares is off by more than its excess explains."""
        shared = self.state.sources[: self.graph.common]
        return bool((np.abs(shared) > MAX_SOURCE * self.graph.excess).any())


def adjust(
    graph: PoseGraph, start: GraphState, excesses: Sequence[float] = EXCESS, share: float = MAJORITY
) -> Adjusted:
    """The graph adjusted without the contradicting factors, with the least of the excesses that explains the others,
    of which most have to agree, and a ``share`` where it is not the first of the excesses.

    If none does, it is the first of the excesses, and all contradicting factors are left out.
    """
    tried = list[Adjusted]()
    for k in excesses:
        tried.append(done := _decided(replace(graph, excess=k), start))
        if _explained(done, share if len(tried) > 1 else MAJORITY):
            return done
    return tried[0]


def _explained(done: Adjusted, share: float) -> bool:
    """Whether a ``share`` of the doubtful factors counts, with errors that one true graph in a hundred exceeds at
    most, and the chain is not strained."""
    doubtful = done.graph.factors.doubtful
    rows = int((done.graph.factors.root[doubtful & done.kept] != 0).any(2).sum())
    if not rows:
        return not doubtful.any()
    # The chain alone has as many unknowns as equations, so the doubtful factors are the degrees of freedom.
    squares = 2.0 * done.graph.normal(done.state).cost
    return bool(
        not done.strained and done.kept[doubtful].mean() >= share and squares <= scipy.special.chdtri(rows, 0.01)
    )


def _decided(graph: PoseGraph, state: GraphState) -> Adjusted:
    """Which of the doubtful factors count, by graduated non-convexity, and the state that follows."""
    doubtful, bound = graph.factors.doubtful, graph.factors.bound
    state = levenberg_marquardt(graph, state, STEPS).state
    squared = (graph.errors(state) ** 2).sum(1)
    # Where the cost is convex at first; nothing is to be undone where all factors agree.
    worst = float((squared[doubtful] / bound[doubtful]).max(initial=0.0))
    mu = 1.0 / max(2.0 * worst - 1.0, 1e-9)
    for _ in range(MAX_ROUNDS):
        if worst <= 1.0 or mu > 1e6:
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            between = np.sqrt(bound / squared * mu * (mu + 1.0)) - mu
        weight = np.where(doubtful, np.clip(np.where(squared > 0, between, 1.0), 0.0, 1.0), 1.0)
        graph = replace(graph, weight=weight)
        state = levenberg_marquardt(graph, state, FEW_STEPS).state
        squared = (graph.errors(state) ** 2).sum(1)
        if np.isin(weight, (0.0, 1.0)).all():
            break
        mu *= GRADUATION
    graph = replace(graph, weight=np.where(doubtful, np.where(squared <= bound, 1.0, 0.0), 1.0))
    return Adjusted(graph, levenberg_marquardt(graph, state, STEPS).state)
