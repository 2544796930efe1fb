"""Recordings: HDF5 format, writer, reader, Rerun export."""
