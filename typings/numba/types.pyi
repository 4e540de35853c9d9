from typing import Any

int64: Any
uint32: Any
uint64: Any
float32: Any
void: Any
