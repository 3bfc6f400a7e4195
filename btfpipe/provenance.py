"""What a result was made from: digests of source code."""

import hashlib
import os
from pathlib import Path


def source_digest(*parts):
    """Digest of the package's source, so that a stage reruns when the code it leans on changes.

    Parameters
    ----------
    *parts : str
        Folders or modules under the package (``"sample"``, ``"store.py"``); none means all of it.

    Returns
    -------
    str
        12 hex digits.
    """
    root = Path(__file__).parent
    files = set()
    for part in parts or (".",):
        path = root / part
        files.update([*path.rglob("*.py"), *path.rglob("*.yaml")] if path.is_dir() else [path])
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def code_digest():
    """Digest of the package's modules, of 12 hex digits: what compiled code was made from.

    Those of the command line are left out: no kernel is there, and nothing imports them. Every process that compiles anything
    asks for it, so it has no more to do than to read the files.
    """
    root = os.path.dirname(os.path.abspath(__file__))
    paths = [
        os.path.join(folder, name)
        for folder, _, names in os.walk(root)
        if folder != os.path.join(root, "cli")
        for name in names
        if name.endswith(".py")
    ]
    digest = hashlib.sha256()
    for path in sorted(paths):
        with open(path, "rb", buffering=0) as file:
            content = file.read()
        name = path[len(root) :].replace(os.sep, "/")
        digest.update(b"%s\0%d\0%s" % (os.fsencode(name), len(content), content))
    return digest.hexdigest()[:12]
