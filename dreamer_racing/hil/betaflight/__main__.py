"""Print the settings of a flight controller for an actor, or check a dump of it; see the package."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight.settings import LINKS, Status, check_dump, print_settings

logger = logging.getLogger(__name__)


def main() -> None:
    """Print the settings, or check a dump."""
    parser = argparse.ArgumentParser(prog="python -m dreamer_racing.hil.betaflight", description=main.__doc__)
    parser.add_argument("do", choices=("print", "check"))
    parser.add_argument("--contract", required=True, help="contract.json of the actor")
    parser.add_argument("--link", choices=LINKS, default="crsf", help="how the flight controller gets commands")
    parser.add_argument("--dump", help="for check: file with the output of `dump all` or `diff all`")
    arguments = parser.parse_args()
    if (arguments.do == "check") != (arguments.dump is not None):
        parser.error("check needs --dump FILE, and print takes none.")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        contract = read_contract(arguments.contract)
        if arguments.do == "print":
            logger.info("\n".join(print_settings(contract, arguments.link)))
            return
        text = Path(arguments.dump).read_text(encoding="utf-8", errors="replace")
        findings = check_dump(text, contract, arguments.link)
    except (OSError, ValueError) as error:
        parser.exit(2, f"{error}\n")
    wrong = [finding for finding in findings if finding.status is not Status.OK]
    logger.info("\n".join(map(str, findings)))
    logger.info("%d of %d settings differ or are missing.", len(wrong), len(findings))
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
