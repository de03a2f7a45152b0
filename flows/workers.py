"""Steps side by side as Prefect tasks, through Prefect's Dask task runner."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import TracebackType
from typing import Any

from distributed import Client
from prefect.client.orchestration import get_client
from prefect_dask import DaskTaskRunner

from flows.tasks import ended_as_by_ctrl_c, task_of
from genassets.pipeline.executor import Word
from genassets.pipeline.parcel import Done, Parcel
from genassets.workers.dask_workers import DaskWorkers, do_parcel


class PrefectWorkers(DaskWorkers):
    """Workers that make a Prefect task run of each step; use within a flow, as a context manager."""

    def __init__(self, count: int | None, address: str | None, on_gpu: Collection[str]) -> None:
        """``on_gpu``: as for ``run_as_task``; the rest as for other workers."""
        super().__init__(count, address)
        self._on_gpu = on_gpu
        self._runner: DaskTaskRunner | None = None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._runner is not None:
                self._runner.__exit__(kind, error, trace)
        finally:
            super().__exit__(kind, error, trace)

    def next_word(self) -> Word:
        with ended_as_by_ctrl_c():
            return super().next_word()

    def _submit(self, client: Client, parcel: Parcel, inputs: Mapping[str, str]) -> Any:
        if self._runner is None:
            runner = DaskTaskRunner(address=self.address, client_kwargs={"security": self._security()})
            self._runner = runner.__enter__()

        def step(inputs: dict[str, str]) -> Done:
            return do_parcel(parcel)

        as_task = task_of(parcel.key, step, self._on_gpu)
        return self._runner.submit(as_task, {"inputs": dict(inputs)})

    def _environment(self) -> dict[str, str]:
        # Else each process would start a Prefect server of its own.
        with get_client(sync_client=True) as api:
            return {"PREFECT_API_URL": str(api.api_url)}
