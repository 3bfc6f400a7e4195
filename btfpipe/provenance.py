"""What a result was made from: digests of source code."""

import hashlib
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
