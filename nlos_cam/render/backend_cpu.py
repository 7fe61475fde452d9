"""Backend for the CPU: glossy surfaces by lobes, all others by the factorized tables alone."""

from nlos_calibration.arrays import Float32

from nlos_cam.render import backend_numba, glossy
from nlos_cam.render.echoes import MultiBounce
from nlos_cam.render.job import TransportJob


def histograms(job: TransportJob) -> Float32:
    """Return histograms (n, bins) of I_multi over path length, for the beams of a job."""
    if job.brdf is None:
        return backend_numba.histograms(job)
    return glossy.histograms(job)


def echoes(job: TransportJob) -> MultiBounce:
    """Return the strongest bins (n,) of the job's beams: those of `histograms`, bit for bit, from a
    part of its work.
    """
    if job.brdf is None:
        return backend_numba.echoes(job)
    return glossy.echoes(job)
