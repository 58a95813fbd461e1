"""A module of PTX as a library of the host: `python module.py IN.ptx OUT.so`, which the stand-in's driver calls."""

import os
import re
import shutil
import struct
import subprocess
import sys

import ptx
from translate import Body, identifier

# tests compile much and compute little: -O1 takes three times as long to compile and gains nothing
_FLAGS = ["-O0", "-w", "-shared", "-fPIC", "-ffp-contract=off", "-fwrapv", "-fno-strict-aliasing", "-fno-math-errno"]


def to_c(text: str) -> str:
    module = ptx.read(text)
    shared, shared_bytes = _layout(_shared_variables(module))
    places, total = _layout([v for v in module.variables if v.space in ("global", "const")])
    functions = [f for f in module.functions if f.body is not None]
    bodies = {f.name: Body(f, shared) for f in functions}
    _spread_exchanges(bodies)
    entries = [f for f in functions if f.is_entry]
    lines = ['#include "prelude.h"']
    lines += [f"#define {identifier(name)} (globals + {offset})" for name, offset in places.items()]
    lines += [_signature(f) + ";" for f in functions]
    for function in functions:
        lines += [_signature(function), "{", *_parameter_places(function), *bodies[function.name].lines, "}"]
    lines += [f"const struct entry entries[] = {{{', '.join(_entry(f, bodies[f.name].exchanges) for f in entries)}}};"]
    lines += [f"const int entry_count = {len(entries)}, flushes_denormals = {int('.ftz' in text)};"]
    lines += [f"const int global_bytes = {total}, shared_bytes = {shared_bytes};"]
    lines += [f"const unsigned char initial[] = {{{', '.join(map(str, _first_values(module, places, total))) or 0}}};"]
    return "\n".join(lines) + "\n"


def _shared_variables(module: ptx.Module) -> list[ptx.Variable]:
    inside = [item for f in module.functions for item in f.body or [] if isinstance(item, ptx.Variable)]
    return [v for v in module.variables + inside if v.space == "shared"]


def _layout(variables: list[ptx.Variable]) -> tuple[dict[str, int], int]:
    places, end = {}, 0
    for variable in variables:
        end = -(-end // variable.alignment) * variable.alignment
        places[variable.name] = end
        end += variable.bytes
    return places, end


def _first_values(module: ptx.Module, places: dict[str, int], total: int) -> bytes:
    out = bytearray(total)
    for variable in module.variables:
        size = ptx.BYTES[variable.kind]
        for k, word in enumerate(variable.values or []):
            at = places[variable.name] + k * size
            number = (
                int(word[2:], 16) if re.match("0[fFdD]", word) else int(word, 0)
            )  # the address of a name is an error here
            out[at : at + size] = struct.pack("<Q", number % (1 << 64))[:size]
    return bytes(out)


def _spread_exchanges(bodies: dict[str, Body]) -> None:
    """A function waits for other threads too if one that it calls does."""
    changed = True
    while changed:
        changed = False
        for body in bodies.values():
            if not body.exchanges and any(name in bodies and bodies[name].exchanges for name in body.calls):
                body.exchanges = changed = True


def _signature(function: ptx.Function) -> str:
    if function.is_entry:
        return f"void {identifier(function.name)}(char *parameters)"
    names = [identifier(v.name) for v in function.results] or ["no_result"]
    names += [identifier(v.name) for v in function.parameters]
    parameters = ", ".join("char *" + name for name in names)
    return f"static __attribute__((noinline)) void {identifier(function.name)}({parameters})"


def _parameter_places(function: ptx.Function) -> list[str]:
    if not function.is_entry:
        return []
    places, _ = _layout(function.parameters)
    return [f"char *const {identifier(name)} = parameters + {offset};" for name, offset in places.items()]


def _entry(function: ptx.Function, exchanges: bool) -> str:
    places, _ = _layout(function.parameters)
    sizes = ", ".join(str(v.bytes) for v in function.parameters)
    offsets = ", ".join(map(str, places.values()))
    return f"{{{identifier(function.name)}, {int(exchanges)}, {len(places)}, {{{sizes or 0}}}, {{{offsets or 0}}}}}"


def main(source: str, target: str) -> int:
    with open(source) as file:
        text = to_c(file.read())
    code = source.removesuffix(".ptx") + ".c"
    with open(code, "w") as file:
        file.write(text)
    with open("/proc/cpuinfo") as file:
        fused = ["-mfma"] if " fma " in file.read() else []
    compiler = shutil.which("gcc") or shutil.which("clang")
    here = os.path.dirname(os.path.abspath(__file__))
    command = [compiler, *_FLAGS, *fused, "-I", here, code, "-o", target, "-lm"]
    status = subprocess.run(command).returncode
    if status == 0:
        os.remove(code)
    return status


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
