#!/usr/bin/env python3
"""Wraps comments of Rust files at 100 columns, the width of the code.

rustfmt can do this on nightly only (`wrap_comments`, `comment_width`).

    scripts/wrap_comments.py            rewrites files
    scripts/wrap_comments.py --check    lists files with lines that are too long; exit status 1 if there are any

Only blocks with a line that is too long are changed. Fenced code, tables, headings and links are left alone.
"""

import re
import subprocess
import sys
import textwrap

WIDTH = 100
COMMENT = re.compile(r"^(\s*)(///|//!|//)( .*|)$")
BULLET = re.compile(r"^(\s*)([-*] |\d+\. )?")
FIXED = re.compile(r"^\s*(\||#|\[[^\]]+\]:|<)")


def wrapped(prefix, bodies):
    """Wrap one block of comments, given the text after the marker of each line."""
    out, paragraph, fenced = [], [], False

    def flush():
        if not paragraph:
            return
        lead, bullet = BULLET.match(paragraph[0]).groups(default="")
        words = " ".join([paragraph[0][len(lead) + len(bullet) :]] + [line.strip() for line in paragraph[1:]])
        lines = textwrap.wrap(
            words,
            width=WIDTH - len(prefix) - 1,
            initial_indent=lead + bullet,
            subsequent_indent=lead + " " * len(bullet),
            break_long_words=False,
            break_on_hyphens=False,
        )
        out.extend(f"{prefix} {line}" for line in lines)
        paragraph.clear()

    for body in bodies:
        text = body[1:] if body.startswith(" ") else body
        fence = text.strip().startswith("```")
        indented = text.startswith("    ") and not paragraph
        if fence or fenced or not text.strip() or FIXED.match(text) or indented:
            flush()
            fenced ^= fence
            out.append((prefix + body).rstrip())
            continue
        if re.match(r"^\s*([-*] |\d+\. )", text):
            flush()
        paragraph.append(text)
    flush()
    return out


def process(lines):
    out, at = [], 0
    while at < len(lines):
        found = COMMENT.match(lines[at])
        if not found:
            out.append(lines[at])
            at += 1
            continue
        end, bodies = at, []
        while end < len(lines) and (other := COMMENT.match(lines[end])) and other.groups()[:2] == found.groups()[:2]:
            bodies.append(other.group(3))
            end += 1
        block = lines[at:end]
        out += wrapped("".join(found.groups()[:2]), bodies) if any(len(line) > WIDTH for line in block) else block
        at = end
    return out


def main():
    check = sys.argv[1:] == ["--check"]
    files = subprocess.run(["git", "ls-files", "*.rs"], capture_output=True, text=True, check=True).stdout.split()
    failed = False
    for path in files:
        with open(path, encoding="utf-8") as file:
            text = file.read()
        new = "\n".join(process(text.split("\n")))
        if new == text:
            continue
        failed = True
        if check:
            print(f"{path}: comments wider than {WIDTH} columns; run scripts/wrap_comments.py")
        else:
            with open(path, "w", encoding="utf-8") as file:
                file.write(new)
    sys.exit(1 if check and failed else 0)


if __name__ == "__main__":
    main()
