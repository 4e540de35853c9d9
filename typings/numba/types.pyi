from typing import Any

boolean: Any
int64: Any
uint16: Any
float64: Any
uint32: Any
uint64: Any
float32: Any
void: Any
