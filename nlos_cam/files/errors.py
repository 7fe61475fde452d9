"""Root of nlos-cam's own errors, and those of writing files; the whole tree is in
`nlos_cam.errors`.
"""


class NlosCamError(Exception):
    """Root of nlos-cam's own errors: "sim cannot be recorded: give a live camera (l515, sim)"."""

    exit_code = 1


class OutputExistsError(NlosCamError, FileExistsError):
    """Output path that exists: "run.bag exists: choose another name, or add --overwrite to replace
    it".
    """


class FileBusyError(NlosCamError, BlockingIOError):
    """File or folder that another process writes: "a.bag is being written by process 7 on lab: wait
    for it, or choose another name".
    """
