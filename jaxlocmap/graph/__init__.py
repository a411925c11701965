"""Pose graphs: a chain of odometry, loops between its poses, robust kernels, solvers and covariances.

```python
import jax
from jaxlocmap import graph, simulation

truth, g = simulation.simulate_graph(jax.random.key(0), poses=100, loops=10, false=3)
solution = graph.solve(g, kernel="gnc")  # poses, weights of the loops, chi2, converged
cov = graph.marginals(g, solution, frame="pose")  # of x, y, theta; "body" as GTSAM has it; or "world"
assert not graph.faults(g, solution)  # else: why it did not converge, in words
```

`solve` works under `jit`, `grad` and `vmap` over graphs of different shape (`stack`). Up to 150 loops the linear
systems are solved in the space of the loops, in pure JAX; beyond, by CHOLMOD (`pip install 'jaxlocmap[sparse]'`; it
raises for a matrix that is not positive definite, under `jit` for the whole call) or SciPy. `shard_map` wants
`check_vma=False`. No factor is taken from the residuals: the covariance is that of the information that the edges
state; `tune_scales` finds by gradient, from true poses, what odometry and loops are to be widened by. The error of an
edge is g2o's, (Z⁻¹ A⁻¹ B) as (x, y, θ).

Derivatives of `solve` by measurements, information and the kernel's scale are those of the optimum, by the implicit
function theorem; zero by which loops `gnc` keeps and by where the search starts, but for the first pose.

Loop closure (`closure`): a new submap's scans are matched as one on the map of an older one, within three standard
deviations of where the graph has it. The covariance of the loop is that of the match plus that of how the filter knows
scans to lie in either submap; it is closed if enough points lie on lines, if the walls tell the place to 3 cm in every
direction, and if χ² under the covariance of the graph is below the 0.999 quantile.
"""

from jaxlocmap.graph.covariance import marginals, relative_covariances
from jaxlocmap.graph.factors import Graph, chi2, dead_reckoning, errors, stack
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.scales import Scales, pose_nll, scaled, tune_scales
from jaxlocmap.graph.solver import Solution, faults, solve
from jaxlocmap.graph.start import chordal

__all__ = [
    "Graph",
    "Kernel",
    "Scales",
    "Solution",
    "chi2",
    "chordal",
    "dead_reckoning",
    "errors",
    "faults",
    "marginals",
    "pose_nll",
    "relative_covariances",
    "scaled",
    "solve",
    "stack",
    "tune_scales",
]
