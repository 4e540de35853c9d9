"""What CroP uses of reportlab 4 and 5: paths of rectangles, in points, y up."""

class PDFPathObject:
    def rect(self, x: float, y: float, width: float, height: float) -> None: ...
