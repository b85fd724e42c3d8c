"""Figures and claims of the paper, from its Tables II and III and the text of its section V."""

DETECTION = {
    "YOLOv3": {"precision": 0.8395, "recall": 0.9258, "ap50_paper": 0.8926, "f1": 0.8805},
    "attention-YOLOv3": {"precision": 0.8458, "recall": 0.9336, "ap50_paper": 0.8963, "f1": 0.8875},
}
"""Table II, by network."""
TARGET_AP = DETECTION["YOLOv3"]["ap50_paper"]
"""The paper's AP of YOLOv3 without attention. The headline ground is selected by this AP."""
NAVIGATION = {
    "Darknet53-LSTM": {"position_m": 7.61, "orientation_deg": 1.1e-2, "seconds": 0.22},
    "attention-Darknet53-LSTM": {"position_m": 1.14, "orientation_deg": 5.5e-3, "seconds": 0.22},
}
"""Table III, by network: RMSE per component by the paper's formula, and seconds per pair on a Xeon W-10855M. The paper
labels the column of seconds as fps."""
SHALLOW_CRATER_GATES = ("B_11", "B_35")
"""Gates for which the paper reports a moderate PCC1."""
DEEP_ALIKE_GATES = ("B_48", "B_51", "B_52", "B_53", "B_54")
"""Gates for which the paper reports a PCC2 above `DEEP_ALIKE`."""
DEEP_ALIKE = 0.75
MODERATE = 0.3
"""Smallest correlation that we call moderate; the paper gives no number (Cohen 1988: 0.3 to 0.5)."""
MOTION_GATES = ("B_11", "B_21", "B_22", "B_31", "B_32", "B_34")
"""Gates for which the paper reports a PCC4 above PCC3."""
STILL_GATES = ("B_37", "B_38", *(f"B_4{k}" for k in range(1, 9)), *(f"B_5{k}" for k in range(1, 5)))
"""Gates from B_37 on, for which the paper reports a PCC3 above PCC4."""
