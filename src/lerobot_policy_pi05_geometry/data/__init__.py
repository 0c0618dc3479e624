"""What a dataset or a robot hands over, in the form that the policy needs: images, prompt, statistics."""
