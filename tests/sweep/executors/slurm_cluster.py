"""A Slurm cluster of one node in a temporary folder, of Debian's packages `slurm-wlm` and `munge`."""

import contextlib
import getpass
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

COMMANDS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "scontrol")
PATIENCE = 60.0  # seconds until the node is ready, or the queue empty
CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
JobCompType=jobcomp/filetxt
JobCompLoc={folder}/jobs.txt
MpiDefault=none
ReturnToService=2
KillWait=5
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores}
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP OverSubscribe=FORCE:4
"""


def find_missing_commands() -> list[str]:
    return [name for name in COMMANDS if not shutil.which(name, path=_extend_path())]


def _extend_path() -> str:
    return os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])


def find_free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


@contextlib.contextmanager
def running_cluster() -> Iterator[Path]:
    """Start the cluster without accounting; yield its folder of logs. SLURM_CONF is set meanwhile."""
    folder = Path(tempfile.mkdtemp(prefix="slurm", dir="/tmp"))  # a socket's path must be short
    folder.chmod(0o755)
    host, names = socket.gethostname().split(".")[0], ("state", "spool")
    for name in names:
        (folder / name).mkdir()
    facts = {"host": host, "ports": find_free_ports(2), "user": getpass.getuser(), "cores": os.cpu_count()}
    (folder / "slurm.conf").write_text(CONFIG.format(folder=folder, **facts))
    (folder / "key").write_bytes(os.urandom(128))
    (folder / "key").chmod(0o600)
    files = {"socket": "munge.socket", "key-file": "key", "pid-file": "munge.pid", "seed-file": "seed"}
    options = [f"--{key}={folder / name}" for key, name in files.items()]
    lines = [
        ["munged", "--foreground", "--force", f"--log-file={folder}/munge.log", *options],
        ["slurmctld", "-D", "-c"],
        ["slurmd", "-D", "-N", host],
    ]
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf"), "PATH": _extend_path()}
    before = os.environ.copy()
    os.environ.update(environment)
    with contextlib.ExitStack() as stack:
        stack.callback(lambda: (os.environ.clear(), os.environ.update(before), shutil.rmtree(folder)))
        for line in lines:
            log = stack.enter_context(open(folder / f"{line[0]}.log", "ab"))
            process = stack.enter_context(subprocess.Popen(line, stdout=log, stderr=log))
            stack.callback(process.terminate)
        stack.callback(end_jobs)
        _wait(lambda: "idle" in slurm("sinfo", "--noheader", "--format=%t"), folder)
        yield folder


def _wait(condition, folder: Path) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, [path.read_text()[-500:] for path in folder.glob("*.log")]
        time.sleep(0.2)


def end_jobs() -> None:
    slurm("scancel", f"--user={os.getuid()}")
    end = time.monotonic() + PATIENCE
    while list_jobs() and time.monotonic() < end:
        time.sleep(0.5)


def slurm(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def list_ends(folder: Path) -> list[dict[str, str]]:
    """The ended jobs by Slurm's own record, in order, each with its `name`. Its JobState is PENDING each time
    that it was queued again."""
    path = folder / "jobs.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in lines]
    return [row | {"name": f"{row['ArrayJobId']}_{row['ArrayTaskId']}"} for row in rows]


def list_jobs() -> dict[str, str]:
    """The state of each job in the queue, by name."""
    lines = slurm("squeue", "--noheader", "--array", "--format=%i %T").splitlines()
    return dict(line.split() for line in lines)
