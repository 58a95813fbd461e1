"""PTX to C: a function of C for each function of PTX, a local variable for each register, goto for bra.

A kernel is known by its place in the module, not by its name, which holds counters of the process that made it.
"""

import re
import struct

import instructions
import ptx
from instructions import C_TYPES, Unsupported

_REGISTERS = {"pred": "_Bool", "f32": "float", "f64": "double"} | {
    f"{kind}{bits}": f"uint{bits}_t" for kind in "bsu" for bits in (8, 16, 32, 64)
}
_SPECIAL = {
    f"%{name}.{axis}": f"T->{name}[{k}]" for name in ("tid", "ntid", "ctaid", "nctaid") for k, axis in enumerate("xyz")
}
_SPECIAL |= {"%laneid": "T->lane", "WARP_SZ": "32", "%clock": "1", "%clock64": "1", "%globaltimer": "1"}
_SPECIAL |= {"%lanemask_lt": "((1u << T->lane) - 1)", "%lanemask_eq": "(1u << T->lane)"}
_SPACES = {"param", "local", "shared", "global", "const"}
_SHUFFLES = {"up": "SHUFFLE_UP", "down": "SHUFFLE_DOWN", "bfly": "SHUFFLE_XOR", "idx": "SHUFFLE_INDEX"}
_VOTES = {"ballot": "VOTE_BALLOT", "any": "VOTE_ANY", "all": "VOTE_ALL"}
_HOST_FUNCTIONS = {  # what CUDA provides to kernels, and the types of its parameters
    "__assertfail": ("assertion", ("uint64_t", "uint64_t", "uint32_t", "uint64_t")),
    "vprintf": ("print", ("uint64_t", "uint64_t")),
}


def identifier(name: str) -> str:
    return "v_" + re.sub(r"\W", "_", name)


class Body:
    """C of one function."""

    def __init__(self, function: ptx.Function, shared: dict[str, int]):
        self.calls, self.exchanges = set(), False
        self._kinds, self._shared = {}, shared
        self.lines = [line for item in function.body for line in self._item(item)]

    def _item(self, item) -> list[str]:
        if isinstance(item, str):
            return [self._label(item[:-1]) + ":;" if item.endswith(":") else item]
        if isinstance(item, ptx.Registers):
            self._kinds[item.name] = item.kind
            names = [item.name] if item.count is None else [f"{item.name}{k}" for k in range(item.count)]
            return [f"{_REGISTERS[item.kind]} {', '.join(map(self._register, names))};"]
        if isinstance(item, ptx.Variable):
            if item.space == "shared":
                return []
            return [
                f"char {identifier(item.name)}[{max(item.bytes, 1)}] __attribute__((aligned({max(item.alignment, 8)})));"
            ]
        return [self._instruction(item)]

    # operands

    @staticmethod
    def _label(name: str) -> str:
        return "L" + re.sub(r"\W", "_", name)

    @staticmethod
    def _register(name: str) -> str:
        return name.lstrip("%")

    def _kind(self, register: str) -> str | None:
        return self._kinds.get(register) or self._kinds.get(register.rstrip("0123456789"))

    def _read(self, operand: str, kind: str) -> str:
        """A word as a value of type `kind`: a register, a number, a special register or the address of a name."""
        if operand in _SPECIAL:
            return _SPECIAL[operand]
        if operand[0] == "!":
            return f"!{self._read(operand[1:], kind)}"
        if re.match(r"-?\d", operand):
            return self._number(operand, kind)
        own = self._kind(operand)
        if own is None:
            return self._address(operand)
        name = self._register(operand)
        if instructions.is_real(own) == instructions.is_real(kind):
            return name if own == kind or kind == "pred" else f"({C_TYPES[kind]}){name}"
        return f"bits_{own}({name})" if instructions.is_real(own) else f"{kind}_bits({name})"

    @staticmethod
    def _number(text: str, kind: str) -> str:
        if text[:2].lower() in ("0f", "0d"):
            value = struct.unpack(">f" if text[1] in "fF" else ">d", bytes.fromhex(text[2:]))[0]
            suffix = "f" if kind == "f32" else ""
            return f"({value.hex()}{suffix})" if value - value == 0 else f"{kind}_bits(0x{text[2:]})"
        if kind == "pred":
            return str(int(int(text, 0) != 0))
        return (
            f"({C_TYPES[kind]}){hex(int(text, 0) % (1 << instructions.bits(kind)))}u{'ll' if kind[1:] == '64' else ''}"
        )

    def _address(self, name: str) -> str:
        if name in self._shared:
            return f"(uint64_t)(T->shared + {self._shared[name]})"
        return f"(uint64_t){identifier(name)}"

    def _place(self, address: ptx.Address, modifiers: list[str]) -> tuple[str, str]:
        """C of an address, and how to get at what lies there: checked, or known to be this thread's own."""
        own = {"param", "local", "shared"} & set(modifiers)
        offset = f" + {address.offset}" if address.offset >= 0 else f" - {-address.offset}"
        return self._read(address.base, "u64") + offset, "OWN" if own else "CHECKED"

    def _write(self, register: str, kind: str, value: str) -> str:
        if register == "_":
            return f"(void)({value});"
        own, name = self._kind(register), self._register(register)
        if instructions.is_real(own) and not instructions.is_real(kind):
            value = f"{own}_bits({value})"
        elif instructions.is_real(kind) and not instructions.is_real(own):
            value = f"bits_{kind}({value})"
        return f"{name} = {value};"

    # instructions

    def _instruction(self, item: ptx.Instruction) -> str:
        name, *modifiers = item.opcode.split(".")
        try:
            code = getattr(self, f"_do_{name}", self._arithmetic)(name, modifiers, *item.operands)
        except (Unsupported, KeyError, TypeError, ValueError):
            words = " ".join([item.opcode, *map(str, item.operands)])
            code = f'T->stop("the stand-in does not know this instruction: {words[:200]}");'.replace("\n", " ")
        if item.guard:
            test = self._read(item.guard, "pred")
            return f"if ({test}) {{ {code} }}"
        return code

    def _arithmetic(self, name, modifiers, target, *operands) -> str:
        kind = modifiers[-1]
        template, result, kinds = instructions.arithmetic(name, modifiers, kind)
        values = [self._read(operand, k) for operand, k in zip(operands, kinds)]
        return self._write(target, result, template.format(*values, t=kind))

    def _do_membar(self, name, modifiers, *operands) -> str:
        return ";"  # threads run one at a time

    _do_fence = _do_prefetch = _do_prefetchu = _do_nanosleep = _do_discard = _do_membar

    def _do_bra(self, name, modifiers, label) -> str:
        return f"goto {self._label(label)};"

    def _do_ret(self, name, modifiers) -> str:
        return "return;"

    def _do_exit(self, name, modifiers) -> str:
        return "T->leave();"

    def _do_trap(self, name, modifiers) -> str:
        return 'T->stop("trap");'

    def _do_mov(self, name, modifiers, target, source) -> str:
        kind = modifiers[-1]
        if isinstance(target, list):  # a word into its parts
            bits = instructions.bits(kind) // len(target)
            parts = [
                self._write(part, f"u{bits}", f"(uint{bits}_t)(word >> {bits * k})") for k, part in enumerate(target)
            ]
            return f"{{ uint64_t word = {self._read(source, f'u{kind[1:]}')}; {' '.join(parts)} }}"
        if isinstance(source, list):
            bits, whole = instructions.bits(kind) // len(source), C_TYPES[kind]
            parts = [
                f"({whole})(uint{bits}_t){self._read(part, f'u{bits}')} << {bits * k}" for k, part in enumerate(source)
            ]
            return self._write(target, kind, " | ".join(parts))
        return self._write(target, kind, self._read(source, kind))

    def _do_cvta(self, name, modifiers, target, source) -> str:
        return self._write(target, "u64", self._read(source, "u64"))  # one space of addresses holds them all

    def _do_cvt(self, name, modifiers, target, source) -> str:
        to, of = modifiers[-2:]
        return self._write(target, to, instructions.conversion(modifiers[:-2], to, of, self._read(source, of)))

    def _do_setp(self, name, modifiers, target, a, b, other=None) -> str:
        kind = modifiers[-1]
        test = instructions.comparison(modifiers[0], kind, self._read(a, kind), self._read(b, kind))
        sign = {"and": "&", "or": "|", "xor": "^"}[modifiers[1]] if other else None
        parts = target if isinstance(target, list) else [target]
        values = [
            value if other is None else f"{value} {sign} {self._read(other, 'pred')}" for value in ("test", "!test")
        ]
        return (
            f"{{ _Bool test = {test}; {' '.join(self._write(p, 'pred', value) for p, value in zip(parts, values))} }}"
        )

    def _do_selp(self, name, modifiers, target, a, b, choice) -> str:
        kind = modifiers[-1]
        return self._write(
            target, kind, f"{self._read(choice, 'pred')} ? {self._read(a, kind)} : {self._read(b, kind)}"
        )

    def _do_ld(self, name, modifiers, target, address) -> str:
        kind, (place, access) = modifiers[-1], self._place(address, modifiers)
        parts = target if isinstance(target, list) else [target]
        size = ptx.BYTES[kind]
        code = [self._write(part, kind, f"{access}({C_TYPES[kind]}, at + {k * size})") for k, part in enumerate(parts)]
        return f"{{ uint64_t at = {place}; {' '.join(code)} }}"

    def _do_st(self, name, modifiers, address, source) -> str:
        kind, (place, access) = modifiers[-1], self._place(address, modifiers)
        parts = source if isinstance(source, list) else [source]
        size = ptx.BYTES[kind]
        code = [
            f"{access}({C_TYPES[kind]}, at + {k * size}) = {self._read(part, kind)};" for k, part in enumerate(parts)
        ]
        return f"{{ uint64_t at = {place}; {' '.join(code)} }}"

    def _do_atom(self, name, modifiers, target, address, operand, other=None) -> str:
        kind, (place, access) = modifiers[-1], self._place(address, modifiers)
        of = "u" + kind[1:] if kind[0] == "b" else kind
        value = instructions.atomic(modifiers[-2], of, other and self._read(other, of))
        c_type = C_TYPES[of]
        return (
            f"{{ {c_type} *at = &{access}({c_type}, {place}), new = {self._read(operand, of)}, old = *at; "
            f"*at = {value}; {self._write(target, of, 'old')} }}"
        )

    def _do_red(self, name, modifiers, *operands) -> str:
        return self._do_atom(name, modifiers, "_", *operands)

    def _do_bar(self, name, modifiers, which, *count) -> str:
        self.exchanges = True
        if "warp" in modifiers:
            return f"{{ int valid; T->exchange(WARP_BARRIER, {self._read(which, 'u32')}, 0, 0, 0, &valid); }}"
        if "sync" not in modifiers or count:
            raise Unsupported
        return "T->barrier();"

    _do_barrier = _do_bar

    def _do_activemask(self, name, modifiers, target) -> str:
        return self._write(target, "u32", "1u << T->lane")  # each thread for itself, which the language allows

    def _do_shfl(self, name, modifiers, target, value, operand, limits, members) -> str:
        way = next(word for key, word in _SHUFFLES.items() if key in modifiers)
        reads = [self._read(word, "u32") for word in (members, value, operand, limits)]
        return self._exchange(way, target, reads, "u32")

    def _do_vote(self, name, modifiers, target, value, members) -> str:
        way = next(word for key, word in _VOTES.items() if key in modifiers)
        kind = "u32" if way == "VOTE_BALLOT" else "pred"
        return self._exchange(way, target, [self._read(members, "u32"), self._read(value, "pred"), "0", "0"], kind)

    def _exchange(self, way: str, target, reads: list[str], kind: str) -> str:
        self.exchanges = True
        first, *second = target if isinstance(target, list) else [target]
        code = f"uint32_t got = T->exchange({way}, {', '.join(reads)}, &valid); {self._write(first, kind, 'got')}"
        return f"{{ int valid; {code} {' '.join(self._write(p, 'pred', 'valid') for p in second)} }}"

    def _do_call(self, name, modifiers, *operands) -> str:
        """Arguments and results lie in arrays of bytes, as PTX has them."""
        operands = list(operands)
        result = identifier(operands.pop(0)[0]) if isinstance(operands[0], list) else "0"
        target, arguments = operands[0], [identifier(word) for word in (operands[1] if len(operands) > 1 else [])]
        if target in _HOST_FUNCTIONS:
            member, kinds = _HOST_FUNCTIONS[target]
            call = f"T->{member}({', '.join(f'OWN({kind}, {a})' for kind, a in zip(kinds, arguments))});"
            return call if result == "0" else f"OWN(uint32_t, {result}) = {call}"
        given = ", ".join([result, *arguments])
        if self._kind(target):
            signature = ", ".join(["char *"] * (len(arguments) + 1))
            return f"((void (*)({signature})){self._register(target)})({given});"
        self.calls.add(target)
        return f"{identifier(target)}({given});"
