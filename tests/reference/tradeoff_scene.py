"""A small scene whose trade-offs are known by hand: a glued press, as a record and as TOML."""

K_1, K_3, DEPTH = 0.3, 0.02, 4.0
SCENE = {
    "trachea": {"length": "80 mm", "rings": {"count": 7, "first": "10 mm", "last": "70 mm"}},
    "material": {
        "EI_L": "1.86 N mm^2", "k_M": "0.1 N/mm", "k_1": f"{K_1} N/mm", "k_3": f"{K_3} N/mm^3",
        "GA_L": "20 N", "k_1_ring": "0.28 N/mm",
    },
    "model": {"contact": "bonded"},
    "path": {"s": "42 mm", "displacement": ["0 mm", f"-{DEPTH} mm", "0 mm"], "steps": 2},
    "output": {"surface": False, "ring_ends": False},
}  # fmt: skip
TOML = f"""
[trachea]
length = "80 mm"
rings = {{ count = 7, first = "10 mm", last = "70 mm" }}
[material]
EI_L = "1.86 N mm^2"
k_M = "0.1 N/mm"
k_1 = "{K_1} N/mm"
k_3 = "{K_3} N/mm^3"
GA_L = "20 N"
k_1_ring = "0.28 N/mm"
[model]
contact = "bonded"
[path]
s = "42 mm"
displacement = ["0 mm", "-{DEPTH} mm", "0 mm"]
steps = 2
[output]
surface = false
ring_ends = false
pictures = false
"""
