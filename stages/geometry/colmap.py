"""pycolmap without its handler of SIGTERM, which would print a stack trace of C++ instead of running Python's."""

import ctypes
import signal

_get, _set = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
_get.restype = _set.restype = ctypes.c_void_p
_set.argtypes = (ctypes.c_int, ctypes.c_void_p)
# Not signal.signal: a worker imports this outside of its main thread.
_before = _get(signal.SIGTERM)

import pycolmap  # noqa: E402

_set(signal.SIGTERM, _before)

__all__ = ["pycolmap"]
