"""An object store that fails some requests and answers others late; one that vanishes."""

import os

import pytest
from tests.helpers import in_process
from tests.helpers.faulty_proxy import FAULTS, FaultyProxy

from perilune_shared.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_shared.storage.object_stores import store_faults
from perilune_shared.storage.store import open_store
from perilune_shared.validation.validate import validate


def contents(address):
    store = open_store(address)
    return {item.path: store.read(item.path) for item in store.list()}


def test_a_store_that_fails_some_requests_gives_the_same_bytes(little, s3_bucket, monkeypatch, tmp_path):
    pack(open_dataset(little), tmp_path / "packed")
    # One request in seven, since there are only some dozens.
    with FaultyProxy(os.environ["AWS_ENDPOINT_URL"], seed=4, fault_share=0.15, late_share=0.1, late_s=0.3) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        pack(open_dataset(little), f"{s3_bucket}/packed")
        assert validate(open_dataset(f"{s3_bucket}/packed")) == []
        assert contents(f"{s3_bucket}/packed") == contents(tmp_path / "packed")
    assert sum(proxy.counts[name] > 0 for name in FAULTS) >= 3 and proxy.counts["late"], proxy.counts


def test_a_store_that_vanishes_ends_a_command_with_one_line(little, s3_bucket, monkeypatch):
    with FaultyProxy(os.environ["AWS_ENDPOINT_URL"], seed=1, fault_share=0, late_share=0) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        pack(open_dataset(little), f"{s3_bucket}/packed")
        proxy.vanish()
        gone = in_process.call(main, "validate", f"{s3_bucket}/packed")
        proxy.come_back()
        back = in_process.call(main, "validate", f"{s3_bucket}/packed")
    assert gone.returncode == 2 and gone.stderr.strip().count("\n") == 0 and back.returncode == 0
    assert f"error: {s3_bucket}/packed/dataset.json: connection: got " in gone.stderr
    assert gone.stderr.endswith("expected a store that answers; run the same command again to resume\n")


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("Could not connect to http://127.0.0.1:40321/bucket", "connection"),
        ("An error occurred (403) when calling HeadObject: Forbidden", "access"),
        ("401, message='Unauthorized'", "access"),
    ],
)
def test_the_number_of_a_port_is_no_status(text, field):
    with pytest.raises(UserError) as error, store_faults("s3://bucket"):
        raise OSError(text)
    assert error.value.field == field
