"""A bucket of moto's S3 server, filled from a folder and brought back to one."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path


class Bucket:
    """One bucket at a server of this process's own; `close` ends it. Its keys are in the environment.

    Attributes:
      url: of the release in it.
      options: of commands that read or write it.
    """

    url = "s3://campaign/release"

    def __init__(self):
        import boto3
        from moto.server import ThreadedMotoServer

        logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line for each request
        os.environ |= {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}
        self._server = ThreadedMotoServer(port=0, verbose=False)
        self._server.start()
        host, port = self._server.get_host_and_port()
        endpoint = f"http://{host}:{port}"
        self._client = boto3.client("s3", endpoint_url=endpoint)
        self._client.create_bucket(Bucket="campaign")
        self.options = ["--option", f"endpoint_url={endpoint}"]

    def _keys(self) -> list[str]:
        pages = self._client.get_paginator("list_objects_v2").paginate(Bucket="campaign")
        return [item["Key"] for page in pages for item in page.get("Contents", [])]

    def fill(self, folder: Path) -> None:
        """Hold the files of a folder and nothing else."""
        for key in self._keys():
            self._client.delete_object(Bucket="campaign", Key=key)
        for path in folder.rglob("*"):
            if path.is_file():
                key = f"release/{path.relative_to(folder).as_posix()}"
                self._client.put_object(Bucket="campaign", Key=key, Body=path.read_bytes())

    def bring(self, folder: Path) -> Path:
        """Make a folder equal to what the bucket holds."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for key in self._keys():
            path = folder / key.removeprefix("release/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(self._client.get_object(Bucket="campaign", Key=key)["Body"].read())
        return folder

    def close(self) -> None:
        self._server.stop()
