"""A real S3 server on this machine, moto's, in a process of its own; and copies of datasets on it.

Clients find it by the standard variables AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and
AWS_DEFAULT_REGION. `python -m tests.helpers.s3_server` serves until it is killed, and prints its port.
"""

import contextlib
import itertools
import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from perilune_shared.storage.store import open_store

ROOT = Path(__file__).parents[2]
_numbers = itertools.count()


@contextlib.contextmanager
def s3_server() -> Iterator[dict[str, str]]:
    """Start a server; yield the environment variables by which clients find it."""
    command = [sys.executable, "-m", "tests.helpers.s3_server"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield {
                "AWS_ENDPOINT_URL": f"http://127.0.0.1:{int(process.stdout.readline())}",
                "AWS_ACCESS_KEY_ID": "tests",
                "AWS_SECRET_ACCESS_KEY": "tests",
                "AWS_DEFAULT_REGION": "us-east-1",
                "AWS_EC2_METADATA_DISABLED": "true",
            }
        finally:
            process.kill()


@contextlib.contextmanager
def s3_variables() -> Iterator[None]:
    """Start a server, and set its variables in this process's environment while the block runs."""
    with s3_server() as variables:
        before = {name: os.environ.get(name) for name in variables}
        os.environ.update(variables)
        try:
            yield
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})


def new_bucket() -> str:
    """Create an empty bucket; return its address, s3://bucket."""
    name = f"bucket-{os.getpid()}-{next(_numbers)}"
    # moto accepts requests without a signature, so no client is needed.
    request = urllib.request.Request(f"{os.environ['AWS_ENDPOINT_URL']}/{name}", method="PUT")
    with urllib.request.urlopen(request, timeout=30):
        return f"s3://{name}"


def uploaded(folder: Path, address: str) -> str:
    """Copy all files of a folder to an address; return the address."""
    source, target = open_store(folder), open_store(address)
    for item in source.list():
        target.write(item.path, source.read(item.path))
    return address


def main() -> None:
    """Serve on a free port."""
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    server = make_server("127.0.0.1", 0, DomainDispatcherApplication(create_backend_app), threaded=True)
    print(server.port, flush=True)
    server.serve_forever()


if __name__ == "__main__":
    main()
