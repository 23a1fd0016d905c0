"""What happened when and where: effects that an estimate leaves unexplained, found in its residuals (METHOD 15)."""
