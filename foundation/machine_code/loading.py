"""Machine code made executable by LLVM alone: importing numba and having it load its own takes half a second."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any


@dataclass(frozen=True)
class Processor:
    """What code is compiled for.

    - `triple`: the kind of machine, as LLVM names it.
    - `name`, `features`: the processor and its extensions, as LLVM names them.
    - `llvmlite`: version of the library; a newer one brings another LLVM.
    """

    triple: str
    name: str
    features: str
    llvmlite: str


@cache
def processor() -> Processor:
    """Return the processor at hand."""
    import llvmlite
    from llvmlite import binding

    features = binding.get_host_cpu_features().flatten()
    triple = binding.get_process_triple()
    return Processor(triple, binding.get_host_cpu_name(), features, llvmlite.__version__)


def target_machine() -> Any:
    """Return a new target machine of LLVM for the processor at hand, which makes code as numba does."""
    from llvmlite import binding

    at_hand = processor()
    _initialize()
    # Code for x86 is not moved once it is loaded.
    relocation = "static" if at_hand.triple.startswith(("x86", "i386", "i686")) else "default"
    return binding.Target.from_triple(at_hand.triple).create_target_machine(
        cpu=at_hand.name, features=at_hand.features, opt=3, reloc=relocation, codemodel="jitdefault", jit=True
    )


@cache
def _initialize() -> None:
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()


@dataclass(frozen=True)
class Loaded:
    """A function in memory; it lies there as long as this lives."""

    address: int
    engine: Any


def load(code: bytes, symbol: str) -> Loaded:
    """Return the function that an object file has under a name.

    `code`: the bytes of the object file, of the processor at hand. What it refers to must be in the C library.
    """
    from llvmlite import binding

    machine = target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Loaded(engine.get_function_address(symbol), engine)
