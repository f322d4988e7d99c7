"""Downloads, checks and caches the npm packages that pages use, with pinned versions. The registry is
`NPM_CONFIG_REGISTRY`, or registry.npmjs.org by default. Tarballs are kept in the user's cache folder. They
are read member by member, and never unpacked."""

import base64
import hashlib
import os
import tarfile
import urllib.request
from collections.abc import Collection
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.error import URLError

from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.files import atomic_write
from memmlp.common.progress import announce

DEFAULT_REGISTRY = "https://registry.npmjs.org/"
FOLDER = "MEMMLP_NPM"
"""The environment variable that names a folder with tarballs from `npm pack`; it is searched first."""

TIMEOUT = 60  # seconds without a byte
MAX_SIZE = 300_000_000  # bytes of a tarball


@dataclass(frozen=True)
class Package:
    """An npm package with a pinned version and npm's digest of its tarball (sha512-BASE64)."""

    name: str
    version: str
    integrity: str

    def __str__(self) -> str:
        return f"{self.name}@{self.version}"

    @property
    def file(self) -> str:
        """The tarball's file name, the same that `npm pack` gives it."""
        return f"{self.name.removeprefix('@').replace('/', '-')}-{self.version}.tgz"

    def url(self, registry: str) -> str:
        """Return the tarball's address in a registry."""
        return f"{registry.rstrip('/')}/{self.name}/-/{self.name.split('/')[-1]}-{self.version}.tgz"


THREE = Package(
    "three",
    "0.187.0",
    "sha512-Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
)
THREE_VRM = Package(
    "@pixiv/three-vrm",
    "3.5.5",
    "sha512-RPXy7jYAXs704NIpZlosB0U2ENu21G9DrqGWdQgRe8dShaCo1ugpj+6BVPRCy91nt+MPMA96j5rbsSzEl0HlQA==",
)
ONNXRUNTIME_WEB = Package(
    "onnxruntime-web",
    "1.30.0",
    "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
)


def read_package_files(package: Package, names: Collection[str]) -> dict[str, bytes]:
    """Return the content of files in a package, by file name, such as "dist/ort.min.mjs". Raises InputError
    if the package can't be downloaded, and KeyError if it does not have a file."""
    contents = {}
    with tarfile.open(fetch_tarball(package), "r:gz") as archive:
        for member in archive:
            name = member.name.split("/", 1)[-1]  # all lie in one folder, usually "package"
            if member.isfile() and name in names and (file := archive.extractfile(member)):
                contents[name] = file.read()
            if len(contents) == len(set(names)):
                break  # the rest need not be unpacked
    if missing := sorted(set(names) - set(contents)):
        raise KeyError(f"{package} does not have {', '.join(missing)}")
    return contents


def fetch_tarball(package: Package) -> Path:
    """Return a package's tarball. Raises InputError if it can't be downloaded, or has another digest."""
    if (given := os.environ.get(FOLDER)) and (path := Path(given) / package.file).is_file():
        if _has_digest(package, path.read_bytes()):
            return path
        raise InputError(f"{path}: must be {package} with the pinned digest {package.integrity[:20]}...")
    path = find_cache_folder() / package.file
    if not (path.is_file() and _has_digest(package, path.read_bytes())):
        content = _download(package, find_registry_url())
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, content)
    return path


def find_cache_folder() -> Path:
    """Return the folder where downloaded tarballs are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "memmlp" / "npm"


def find_registry_url() -> str:
    """Return the address of the registry."""
    given = (value for name, value in os.environ.items() if name.upper() == "NPM_CONFIG_REGISTRY")
    return next(given, "") or DEFAULT_REGISTRY


def _download(package: Package, host: str) -> bytes:
    announce(f"download {package} from the npm registry and keep it in {find_cache_folder()}")
    instead = f"or run npm pack {package} and set {FOLDER} to the folder with {package.file}"
    try:
        with urllib.request.urlopen(package.url(host), timeout=TIMEOUT) as answer:
            content = answer.read(MAX_SIZE)
    except (OSError, ValueError, HTTPException) as error:  # a ValueError: not a valid address
        reason = error.reason if isinstance(error, URLError) else describe_read_error(error)
        raise InputError(
            f"{package}: cannot be downloaded from the npm registry ({reason}); try again, {instead}"
        ) from None
    if not _has_digest(package, content):
        raise InputError(
            f"{package}: the file from the npm registry does not have the pinned digest; try again, {instead}"
        )
    return content


def _has_digest(package: Package, content: bytes) -> bool:
    return f"sha512-{base64.b64encode(hashlib.sha512(content).digest()).decode()}" == package.integrity
