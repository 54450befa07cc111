"""Values, gradients and Hessians of the triquadratic interpolant; see smooth_kernels."""

from geokit.volume.sampling.sample_kernels import gradient_overloads, sample_overloads
from geokit.volume.sampling.smooth_kernels import smooth_kernels_of
from geokit.volume.sampling.stencil_kernels import Quadratic

sample_quadratic_kernel, gradient_quadratic_kernel, hessian_quadratic_kernel = smooth_kernels_of(Quadratic, __name__)
# Keys: components of a value.
SAMPLE_QUADRATIC = sample_overloads(sample_quadratic_kernel)
GRADIENT_QUADRATIC = gradient_overloads(gradient_quadratic_kernel)
