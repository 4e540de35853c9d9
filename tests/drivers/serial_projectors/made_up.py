"""A language as a user would write it, with replies for every state, and without special features."""

from __future__ import annotations

from drivers.serial_projectors.language import parse_language

TEXT = """
maker = "Lantern"
source = "made up"

[line]
baud = 19200
command = "@{}\\r\\n"
answer = "@{}\\r\\n"
ends = "\\r"

[network]
port = 5000

[refusals]
busy = ["BUSY"]
unknown = ["WHAT"]

[power]
ask = "POWER?"
answer = "POWER {}"
states = { OFF = "standby", ON = "on", HEATING = "warm-up", FANS = "cooling" }
stopped = { HOT = "let it cool for an hour" }
on = "POWER ON"
off = "POWER OFF"
done = "POWER {}"

[mute]
ask = "SHOW?"
answer = "SHOW {}"
states = { NO = true, YES = false }
on = "SHOW NO"
off = "SHOW YES"
done = "SHOW {}"

[faults]
ask = "FAULTS?"
answer = "FAULTS {}"
healthy = "NONE"
parts = { F = "fan", L = "lamp", T = "temperature" }

[lamp_hours]
ask = "HOURS?"
answer = "HOURS {}"

[model]
ask = "MODEL?"
answer = "MODEL {}"

[name]
ask = "NAME?"
answer = "NAME {}"
"""
MADE_UP = parse_language(TEXT, "lantern.toml")
