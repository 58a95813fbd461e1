"""Opens every page of the site in a headless browser, follows every internal link and searches, and says what is wrong.

    python assets/reference/browse.py [FOLDER] [--pictures FOLDER]

FOLDER is what make.py wrote. Needs pip install ".[docs]" and a Chromium, of the system or of playwright. Each page is opened
at the width of a desk and of a phone: it must not be wider than the screen, its pictures must show, it may ask no other
server for anything, and no script may fail, or the exit code is 1. --pictures: screenshots of some pages go there.
"""

import argparse
import functools
import http.server
import shutil
import sys
import threading
from pathlib import Path
from urllib.parse import unquote, urldefrag, urlparse

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
SCREENS = {"desk": (1280, 900, "light"), "phone": (390, 844, "dark")}
# what a reader types -> the pages of which one must be among the first results
WORDS = {
    "StableNeoHookean": "reference/materials.html",
    "friction": "guides/contact_and_friction.html glossary.html reference/contact.html",
    "barrier width": "glossary.html reference/contact.html guides/contact_and_friction.html",
    "fixed": "guides/loads_and_supports.html reference/scenes_and_solvers.html guides/coming_from_others.html",
    "VelocityVerletSolver": "reference/scenes_and_solvers.html",
    "check_gradients": "reference/gradients.html",
    "Gmsh": "guides/meshes.html",
    "identify": "guides/identify.html reference/identification.html",
    "UnequalSteps": "reference/scenes_and_solvers.html",
    "kick drift stage": "diffsim_ti/index.html",
}
PICTURED = ["index.html", "examples/index.html", "examples/guides/meshes.html", "reference/materials.html"]
READ = """() => ({
    ids: [...document.querySelectorAll('[id]')].map(x => x.id),
    links: [...document.querySelectorAll('a[href]')].map(x => x.href),
    broken: [...document.images].filter(x => x.complete && !x.naturalWidth).map(x => x.src),
    wide: document.documentElement.scrollWidth - document.documentElement.clientWidth,
})"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_) -> None: ...


class Visit:
    """One visit of all pages, and what was found wrong."""

    def __init__(self, folder: Path, pictures: Path | None):
        self.folder, self.pictures, self.wrong = folder, pictures, []
        self.pages = sorted(str(path.relative_to(folder)) for path in folder.rglob("*.html") if path.name != "404.html")
        self.ids, self.links = {}, {}

    def open_all(self, page, root: str, screen: str) -> None:
        for name in self.pages:
            page.goto(f"{root}/{name}", wait_until="load")
            read = page.evaluate(READ)
            self.ids[name], self.links[name] = {*read["ids"], ""}, read["links"]
            self.wrong += [f"{name}: the picture {src} does not show" for src in read["broken"]]
            if read["wide"] > 0:
                self.wrong.append(f"{name}: {read['wide']} pixels wider than a {screen}")
            if self.pictures and name in PICTURED:
                page.screenshot(path=self.pictures / f"{name.replace('/', '_').removesuffix('.html')}_{screen}.png")

    def follow_links(self, root: str) -> int:
        count = 0
        for name, links in self.links.items():
            for link in {link for link in links if link.startswith(root)}:
                count += 1
                url, part = urldefrag(link)
                target = unquote(urlparse(url).path).lstrip("/")
                target = target + "index.html" if not target or target.endswith("/") else target
                if not (self.folder / target).is_file() or unquote(part) not in self.ids.get(target, {"", part}):
                    self.wrong.append(f"{name}: the link to {target}#{part} leads nowhere")
        return count

    def search(self, page, root: str, words: str, expected: str) -> None:
        page.goto(f"{root}/index.html")
        page.locator("input[name=query]").click()
        page.locator("input[name=query]").press_sequentially(words)
        results = page.locator(".md-search-result__item > a.md-search-result__link")
        try:
            results.first.wait_for(timeout=10_000)
        except Exception:  # nothing was found
            return self.wrong.append(f"search for {words!r}: no result")
        page.wait_for_timeout(300)  # results come as they are found
        found = [results.nth(k).get_attribute("href") for k in range(min(10, results.count()))]  # page and section
        if not any(wanted in link for link in found for wanted in expected.split()):
            self.wrong.append(f"search for {words!r}: found {found}, not {expected}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=HERE / "html")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    visit = Visit(options.folder.resolve(), options.pictures)
    assert visit.pages, f"{options.folder}: no pages; run make.py first"
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(visit.folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    root = f"http://127.0.0.1:{server.server_port}"
    with sync_playwright() as playwright:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for screen, (width, height, scheme) in SCREENS.items():
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            page.on("pageerror", lambda error, page=page: visit.wrong.append(f"{page.url}: {error}"))
            page.on(
                "request", lambda r: r.url.startswith((root, "data:", "blob:")) or visit.wrong.append(f"asks {r.url}")
            )
            visit.open_all(page, root, screen)
            if screen == "desk":
                for words, expected in WORDS.items():
                    visit.search(page, root, words, expected)
            page.close()
        browser.close()
    links = visit.follow_links(root)
    print("\n".join(sorted({*visit.wrong})))
    print(f"{len(visit.pages)} pages, {links} internal links, {len(WORDS)} searches: {len({*visit.wrong})} wrong")
    return 1 if visit.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
