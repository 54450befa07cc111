"""Values, gradients and Hessians of the tricubic interpolant; see smooth_kernels."""

from geokit.volume.sampling.sample_kernels import gradient_overloads, sample_overloads
from geokit.volume.sampling.smooth_kernels import smooth_kernels_of
from geokit.volume.sampling.stencil_kernels import Cubic

sample_cubic_kernel, gradient_cubic_kernel, hessian_cubic_kernel = smooth_kernels_of(Cubic, __name__)
# Keys: components of a value.
SAMPLE_CUBIC = sample_overloads(sample_cubic_kernel)
GRADIENT_CUBIC = gradient_overloads(gradient_cubic_kernel)
