"""Tables of what a fuzz found: classes of derivatives, checks, coverage, and the command that repeats a failure."""

from collections import Counter, defaultdict

from .judge import CLASSES, FAILED, INACCURATE, KINK, PASSED, REFUSED, SINGLE_ROUNDING, UNRESOLVED, ZERO, Result

ENOUGH = 10  # non-zero derivatives that passed, of every law, solver and input
SHARES = {"obstacle": 0.5, "sticks": 0.2, "slides": 0.2, "self_contact": 0.2, "static_contact": 0.1, "faces": 0.05}
SAID = {
    "obstacle": "an obstacle acts",
    "sticks": "friction sticks",
    "slides": "friction slides",
    "self_contact": "pairs of self-contact press",
    "static_contact": "statics press on an obstacle",
    "faces": "narrow obstacles press on faces in explicit steps",
}
LARGEST_EXPLAINED, LARGEST_ZERO = 0.05, 0.10


class Report:
    """Results of many configurations."""

    def __init__(self):
        self.results: list[Result] = []

    def add(self, result: Result) -> None:
        self.results.append(result)

    @property
    def judged(self) -> list[Result]:
        return [r for r in self.results if not r.refusal]

    @property
    def failures(self) -> list[Result]:
        return [r for r in self.results if r.failed]

    def counts(self) -> Counter:
        """Derivatives by class; a refused configuration counts as many as the others have on average."""
        counts = Counter({verdict: 0 for verdict in CLASSES})
        counts.update(row.verdict for r in self.judged for row in r.rows)
        refused = len(self.results) - len(self.judged)
        counts[REFUSED] = round(refused * sum(counts.values()) / max(len(self.judged), 1))
        return counts

    def coverage(self) -> dict[str, Counter]:
        """Non-zero derivatives that passed, by law, solver, and input of each kind of term."""
        out = defaultdict(Counter)
        for r in self.judged:
            for row in r.rows:
                passed = row.verdict == PASSED
                out["law"][r.law] += passed
                out["solver"][r.solver] += passed
                out["precision"][r.precision] += passed
                out["input"][f"{row.term}.{row.input}"] += passed
        return out

    def shares(self) -> dict[str, float]:
        """Shares of configurations in which contacts do this or that."""
        return {name: sum(r.seen.get(name, False) for r in self.judged) / max(len(self.judged), 1) for name in SHARES}

    def checks(self) -> dict[str, Counter]:
        out = defaultdict(Counter)
        for r in self.judged:
            for name, said in r.checks.items():
                out[name]["right" if said == "right" else FAILED] += 1
        return out

    def complaints(self) -> list[str]:
        """What keeps a long run from being enough."""
        counts, out = self.counts(), []
        total = max(sum(counts.values()), 1)
        explained = sum(counts[k] for k in (REFUSED, UNRESOLVED, INACCURATE, KINK, SINGLE_ROUNDING)) / total
        if self.failures:
            out.append(f"{len(self.failures)} configurations failed")
        if explained > LARGEST_EXPLAINED:
            out.append(f"{explained:.1%} of derivatives are explained, not passed (at most {LARGEST_EXPLAINED:.0%})")
        if counts[ZERO] > LARGEST_ZERO * total:
            out.append(f"{counts[ZERO] / total:.1%} of derivatives are exactly zero (at most {LARGEST_ZERO:.0%})")
        for kind, counter in self.coverage().items():
            short = [f"{name} ({count})" for name, count in sorted(counter.items()) if count < ENOUGH]
            if short:
                out.append(f"{kind}: fewer than {ENOUGH} non-zero derivatives passed of {', '.join(short)}")
        for name, share in self.shares().items():
            if share < SHARES[name]:
                out.append(f"{SAID[name]} in {share:.0%} of configurations (at least {SHARES[name]:.0%})")
        return out

    def __str__(self) -> str:
        counts = self.counts()
        total = max(sum(counts.values()), 1)
        refused = len(self.results) - len(self.judged)
        structures = len({r.structure for r in self.results})
        calmed = sum(r.calm < 1 for r in self.judged)
        lines = [f"{len(self.results)} configurations over {structures} structures, {refused} refused"]
        lines += [f"{calmed} of the others made calmer than they were drawn, for so they were refused", ""]
        lines += [f"{verdict:32s} {counts[verdict]:6d} {counts[verdict] / total:7.2%}" for verdict in CLASSES]
        lines += ["", "other ways to the same gradient"]
        for name, counter in sorted(self.checks().items()):
            lines.append(f"{name:32s} {counter['right']:6d} right {counter[FAILED]:4d} {FAILED}")
        for kind, counter in self.coverage().items():
            lines += ["", f"non-zero derivatives that passed, by {kind}"]
            lines += [f"{name:44s} {count:6d}" for name, count in sorted(counter.items())]
        lines += ["", "configurations in which"]
        lines += [f"{SAID[name]:32s} {share:7.1%}" for name, share in self.shares().items()]
        lines += ["", *(f"MISSING: {complaint}" for complaint in self.complaints())]
        return "\n".join(lines)


def failure_text(result: Result) -> str:
    """What went wrong and how to see it again."""
    lines = [f"FAILED: seed {result.seed}: {result.structure}"]
    lines += [f"    {row}" for row in result.rows if row.verdict == FAILED]
    lines += [f"    {name}: {said}" for name, said in result.checks.items() if said != "right"]
    lines += [f"    {result.error}"] if result.error else []
    return "\n".join([*lines, f"    again: python tests/fuzz_gradients.py --seed {result.seed} --only"])


def as_json(report: Report) -> dict:
    """Everything but single rows that passed."""
    return {
        "configurations": len(report.results),
        "structures": len({r.structure for r in report.results}),
        "classes": dict(report.counts()),
        "checks": {name: dict(counter) for name, counter in report.checks().items()},
        "coverage": {kind: dict(counter) for kind, counter in report.coverage().items()},
        "shares": report.shares(),
        "refusals": {r.seed: r.refusal for r in report.results if r.refusal},
        "not passed": {
            r.seed: [vars(row) for row in r.rows if row.verdict not in (PASSED, ZERO)]
            for r in report.judged
            if any(row.verdict not in (PASSED, ZERO) for row in r.rows)
        },
        "failures": [failure_text(r) for r in report.failures],
        "missing": report.complaints(),
    }
