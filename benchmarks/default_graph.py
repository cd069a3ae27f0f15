# SPDX-License-Identifier: Apache-2.0
"""Writes placerec/weights/default.onnx: how the default network is computed, without its weights.

    python benchmarks/default_graph.py

The graph takes its tensors, in half precision, from where they lie in default.safetensors, so that
the weights are shipped once. To be run whenever these have changed, even their threshold alone.
"""

import hashlib
import json
import sys

from onnx import NodeProto, TensorProto, helper

from placerec.files import write_atomically
from placerec.networks.onnx_export import to_onnx
from placerec.recognizers.default import DEFAULT_GRAPH, DEFAULT_WEIGHTS, WEIGHTS_METADATA
from placerec.recognizers.learned import LearnedRecognizer

_LENGTH_BYTES = 8
"""Of the header of a safetensors file, at its beginning."""
_MODULE = "_network."


def main() -> int:
    """Write the graph."""
    write_atomically(DEFAULT_GRAPH, graph())
    return 0


def graph() -> bytes:
    """Return the graph of the shipped weights; the same weights, the same bytes."""
    learned, content = LearnedRecognizer(), DEFAULT_WEIGHTS.read_bytes()
    model = to_onnx(learned.network, learned.min_similarity)
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    header = json.loads(content[_LENGTH_BYTES:start])
    tensors, casts = [], []
    for tensor in model.graph.initializer:
        if where := header.get(tensor.name.removeprefix(_MODULE)):
            first, end = (start + offset for offset in where["data_offsets"])
            half, cast = _half(tensor, first, end - first)
            tensors.append(half)
            casts.append(cast)
        else:
            tensors.append(tensor)
    nodes = [*casts, *model.graph.node]
    for field, values in ((model.graph.initializer, tensors), (model.graph.node, nodes)):
        kept = [type(value).FromString(value.SerializeToString()) for value in values]
        del field[:]
        field.extend(kept)
    told = {entry.key: entry.value for entry in model.metadata_props} | {
        WEIGHTS_METADATA: hashlib.sha256(content).hexdigest(),
        "fingerprint": learned.fingerprint,
        "title": learned.network.title,
    }
    helper.set_model_props(model, told)
    return bytes(model.SerializeToString())


def _half(tensor: TensorProto, offset: int, length: int) -> tuple[TensorProto, NodeProto]:
    """Return a tensor that lies in the weights, and what makes it one of single precision."""
    half = TensorProto(
        name=f"{tensor.name}.half",
        dims=tensor.dims,
        data_type=TensorProto.FLOAT16,
        data_location=TensorProto.EXTERNAL,
    )
    place = {"location": DEFAULT_WEIGHTS.name, "offset": str(offset), "length": str(length)}
    for key, value in place.items():
        half.external_data.add(key=key, value=value)
    return half, helper.make_node("Cast", [half.name], [tensor.name], to=TensorProto.FLOAT)


if __name__ == "__main__":
    sys.exit(main())
