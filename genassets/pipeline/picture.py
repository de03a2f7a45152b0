"""The stages of an experiment as a tree of text or a Mermaid flowchart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from genassets.pipeline.plan import Workflow, make_plan


@dataclass(frozen=True)
class FlowNode:
    """A stage: how many logs it has an output for (0: one over all), how many steps the store has, what it reads.

    ``uses`` are read only because this run makes them.
    """

    name: str
    summary: str
    logs: int
    cached: int
    needs: tuple[str, ...]
    uses: tuple[str, ...]

    @property
    def label(self) -> str:
        """Name, logs and state in words."""
        steps = max(self.logs, 1)
        state = (
            "in the store"
            if self.cached == steps
            else f"{self.cached} in the store"
            if self.cached
            else "to run"
        )
        logs = f", {self.logs} log{'s' * (self.logs > 1)}" if self.logs else ""
        return f"{self.name}{logs}: {state}"


def flow_nodes(workflow: Workflow) -> list[FlowNode]:
    """The stages of a workflow, each after what it reads."""
    here = {stage.name for stage in workflow.stages}
    cached = [item.step.stage.name for item in make_plan(workflow) if item.action == "cached"]
    return [
        FlowNode(
            stage.name,
            stage.summary,
            len(workflow.shards) if stage.sharded else 0,
            cached.count(stage.name),
            stage.needs,
            tuple(name for name in stage.uses if name in here),
        )
        for stage in workflow.stages
    ]


def text_tree(nodes: Sequence[FlowNode]) -> Iterator[str]:
    """Lines of a tree: each stage below the last of those that it reads, the others named behind it."""
    order = {node.name: index for index, node in enumerate(nodes)}
    parents = {
        node.name: max((*node.needs, *node.uses), key=lambda name: order[name], default="") for node in nodes
    }

    def below(parent: str, indent: str) -> Iterator[str]:
        children = [node for node in nodes if parents[node.name] == parent]
        for node in children:
            last = node is children[-1]
            branch, deeper = ("", "") if not parent else ("└─ ", "   ") if last else ("├─ ", "│  ")
            others = [name for name in (*node.needs, *node.uses) if name != parent]
            also = f"  (also reads {', '.join(others)})" if others else ""
            yield f"{indent}{branch}{node.label}{also}"
            yield from below(node.name, indent + deeper)

    yield from below("", "")


def mermaid_chart(nodes: Sequence[FlowNode]) -> Iterator[str]:
    """Lines of a flowchart: an arrow from each stage to those that read it, dotted where they do without it elsewhere.

    An arrow is left out where a longer way leads there too.
    """
    yield "flowchart LR"
    for node in nodes:
        yield f'  {node.name}["{node.label.replace(": ", "<br>")}"]'
    for node in nodes:
        yield from (f"  {name} --> {node.name}" for name in _direct(node, nodes))
        yield from (f"  {name} -.-> {node.name}" for name in node.uses)
    done = [node.name for node in nodes if node.cached == max(node.logs, 1)]
    if done:
        yield "  classDef stored fill:#dff0e1,stroke:#2c6e37"
        yield f"  class {','.join(done)} stored"


def _direct(node: FlowNode, nodes: Sequence[FlowNode]) -> list[str]:
    """What a stage needs, without what others of its needs read already."""
    by_name = {other.name: other for other in nodes}

    def above(name: str) -> set[str]:
        return {up for need in by_name[name].needs for up in (need, *above(need))}

    indirect = {up for need in node.needs for up in above(need)}
    return [need for need in node.needs if need not in indirect]
