"""The recording: the HDF5 file between acquisition and everything else."""
