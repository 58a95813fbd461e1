"""PTX instructions that compute one value from others, as expressions of C.

{0}, {1}, ... are the operands, {t} is the type's name in PTX. Source: Parallel Thread Execution ISA, chapter 9.
What stands in no table here is no error until a thread reaches it: the driver then stops the process and names it.
"""

C_TYPES = {f"{kind}{bits}": f"{'' if kind == 's' else 'u'}int{bits}_t" for kind in "bsu" for bits in (8, 16, 32, 64)}
C_TYPES |= {"f32": "float", "f64": "double", "pred": "_Bool"}
WIDER = {
    "s16": "int32_t",
    "u16": "uint32_t",
    "s32": "int64_t",
    "u32": "uint64_t",
    "s64": "__int128",
    "u64": "unsigned __int128",
}

_BOTH = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "neg": "-{0}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "xor": "{0} ^ {1}",
    "not": "~{0}",
    "cnot": "!{0}",
    "min": "min_{t}({0}, {1})",
    "max": "max_{t}({0}, {1})",
    "abs": "abs_{t}({0})",
    "popc": "popc_{t}({0})",
    "clz": "clz_{t}({0})",
    "brev": "brev_{t}({0})",
    "prmt": "prmt_{t}({0}, {1}, {2})",
}
_INTEGER = {"div": "div_{t}({0}, {1})", "rem": "rem_{t}({0}, {1})"}
_REAL = {"mul": "{0} * {1}", "div": "{0} / {1}", "fma": "fma_{t}({0}, {1}, {2})", "mad": "fma_{t}({0}, {1}, {2})"}
_REAL |= {name: name + "_{t}({0})" for name in ("sqrt", "rsqrt", "rcp", "sin", "cos", "lg2", "ex2", "tanh")}
_REAL |= {"copysign": "copysign_{t}({0}, {1})"}

_ORDERED = {"eq": "==", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
_UNSIGNED = {"lo": "<", "ls": "<=", "hi": ">", "hs": ">="}
_OPPOSITE = {"ltu": ">=", "leu": ">", "gtu": "<=", "geu": "<", "neu": "=="}
_ROUNDING = {"rni": "rint", "rzi": "trunc", "rmi": "floor", "rpi": "ceil"}


class Unsupported(Exception):
    """An instruction that this translator does not know."""


def is_real(kind: str) -> bool:
    return kind in ("f32", "f64")


def bits(kind: str) -> int:
    return int(kind[1:])


def arithmetic(name: str, modifiers: list[str], kind: str) -> tuple[str, str, list[str]]:
    """C of an instruction, the type of its result, and the types of its operands."""
    if is_real(kind):
        template = (_REAL | {k: v for k, v in _BOTH.items() if k not in ("and", "or", "xor")}).get(name)
        if template is None or {"rz", "rm", "rp"} & set(modifiers):
            raise Unsupported
        if "NaN" in modifiers:
            template = "({0} != {0} || {1} != {1} ? NAN : " + template + ")"
        return (f"saturated_{kind}({template})" if "sat" in modifiers else template), kind, [kind] * 3
    if "cc" in modifiers or "sat" in modifiers:
        raise Unsupported
    if name in ("mul", "mad"):
        return _product(name, modifiers, kind)
    if name in ("shl", "shr"):
        return _shift(name, kind)
    if name in ("bfe", "bfi", "shf"):
        return _field(name, modifiers, kind)
    if kind == "pred" and name == "not":
        return "!{0}", kind, [kind]
    template = (_INTEGER | _BOTH).get(name)
    if template is None:
        raise Unsupported
    return template, "u32" if name in ("popc", "clz") else kind, [kind] * 3


def _product(name: str, modifiers: list[str], kind: str) -> tuple[str, str, list[str]]:
    wide = f"({WIDER[kind]}){{0}} * ({WIDER[kind]}){{1}}"
    out = kind
    if "wide" in modifiers:
        template, out = wide, f"{kind[0]}{2 * bits(kind)}"
    elif "hi" in modifiers:
        template = f"({C_TYPES[kind]})(({wide}) >> {bits(kind)})"
    else:
        template = "{0} * {1}"
    return (f"{template} + {{2}}" if name == "mad" else template), out, [kind, kind, out]


def _shift(name: str, kind: str) -> tuple[str, str, list[str]]:
    """By the word's length or more, nothing is left but the sign."""
    n = bits(kind)
    if name == "shr" and kind[0] == "s":
        return f"{{0}} >> ({{1}} < {n} ? {{1}} : {n - 1})", kind, [kind, "u32"]
    return f"({{1}} < {n} ? {{0}} {'<<' if name == 'shl' else '>>'} {{1}} : 0)", kind, [kind, "u32"]


def _field(name: str, modifiers: list[str], kind: str) -> tuple[str, str, list[str]]:
    if name == "bfe":
        return (
            f"field({{0}}, {{1}}, {{2}}, {bits(kind)}, {int(kind[0] == 's')})",
            kind,
            [f"u{bits(kind)}", "u32", "u32"],
        )
    if name == "bfi":
        return f"insert({{0}}, {{1}}, {{2}}, {{3}}, {bits(kind)})", kind, [kind, kind, "u32", "u32"]
    amount = "({2} & 31)" if "wrap" in modifiers else "({2} < 32 ? {2} : 32)"
    return f"shf_{modifiers[0]}({{0}}, {{1}}, {amount})", kind, ["u32"] * 3


def comparison(test: str, kind: str, a: str, b: str) -> str:
    """setp: of real numbers, tests that end in u hold for NaN too, the others do not."""
    if is_real(kind):
        if test in ("num", "nan"):
            return ("!" if test == "num" else "") + f"isunordered({a}, {b})"
        if test in ("ne", "equ"):
            return ("!" if test == "equ" else "") + f"islessgreater({a}, {b})"
        if test in _OPPOSITE:
            return f"!({a} {_OPPOSITE[test]} {b})"
    sign = "!=" if test == "ne" else (_ORDERED | _UNSIGNED).get(test)
    if sign is None:
        raise Unsupported
    return f"({a} {sign} {b})"


def conversion(modifiers: list[str], target: str, source: str, value: str) -> str:
    """cvt: to integers by the rounding that is named, and never beyond the largest one."""
    rounding = next((m for m in modifiers if m in ("rn", "rz", "rm", "rp", *_ROUNDING)), "rn")
    if rounding in _ROUNDING:
        value = f"{_ROUNDING[rounding]}({value})"
    elif rounding != "rn":
        raise Unsupported
    if is_real(source) and not is_real(target):
        return f"to_{target}({value})"
    if "sat" in modifiers:
        if not is_real(target):
            raise Unsupported
        return f"saturated_{target}(({C_TYPES[target]}){value})"
    return f"({C_TYPES[target]}){value}"


def atomic(action: str, kind: str, compared: str | None) -> str:
    """The next value of memory, from the `old` one and the operand `new`; threads run one at a time, so that it holds."""
    known = {
        "add": "old + new",
        "exch": "new",
        "and": "old & new",
        "or": "old | new",
        "xor": "old ^ new",
        "min": f"min_{kind}(old, new)",
        "max": f"max_{kind}(old, new)",
        "inc": "old >= new ? 0 : old + 1",
        "dec": "!old || old > new ? new : old - 1",
    }
    if action == "cas":
        return f"old == new ? {compared} : old"
    if action not in known:
        raise Unsupported
    return known[action]
